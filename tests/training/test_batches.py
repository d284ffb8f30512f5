"""Batches that a thread gathers on the host."""

import time
from typing import Any

import fakes
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax.core import config
from starjax.data import windows
from starjax.training import batches, devices, state
from starjax.training.sharding import Setup, StateLayout

NOTHING: Any = None
SETUP = Setup(
    policy=NOTHING,
    optimizer=NOTHING,
    policy_config=fakes.TINY,
    train_config=config.TrainConfig(batch_size=16),
    layout=StateLayout(devices.make_mesh(16), lambda params: params, NOTHING),
)


def test_frames_follow_the_step_from_wherever_it_begins(monkeypatch):
    monkeypatch.setattr(batches, "_CHUNK", 4)  # several of them in ten steps
    dataset = jax.tree.map(np.asarray, fakes.dataset(seed=0, demos=2, length=20))
    frames, key, first = np.arange(40), jax.random.key(3), 3
    stream = batches.gathered(SETUP, dataset, frames, key, first)
    for number in range(first, first + 10):
        drawn = windows.sample_frames(state.step_keys(key, number).batch, jnp.asarray(frames), 16)
        wanted = windows.gather(
            dataset, np.asarray(drawn), fakes.TINY.obs_horizon, fakes.TINY.horizon
        )
        jax.tree.map(np.testing.assert_array_equal, next(stream), wanted)
    stream.close()


def test_a_closed_feed_gathers_nothing_more(monkeypatch):
    dataset = jax.tree.map(np.asarray, fakes.dataset(seed=0, demos=2, length=20))
    gathered, gather = [], windows.gather
    monkeypatch.setattr(
        windows, "gather", lambda *given: gathered.append(time.sleep(0.02)) or gather(*given)
    )
    stream = batches.gathered(SETUP, dataset, np.arange(40), jax.random.key(3), 0)
    next(stream)
    stream.close()
    assert len(gathered) < batches._CHUNK // 2


def test_a_fault_of_the_thread_is_raised_where_the_batch_is_asked_for(monkeypatch):
    def fail(*_):
        raise OSError("disk")

    monkeypatch.setattr(windows, "gather", fail)
    dataset = jax.tree.map(np.asarray, fakes.dataset(seed=0, demos=2, length=20))
    stream = batches.gathered(SETUP, dataset, np.arange(40), jax.random.key(3), 0)
    with pytest.raises(OSError, match="disk"):
        next(stream)
