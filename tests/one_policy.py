"""A policy's file for commands, with stubs of the simulator and of the networks."""

import dataclasses

import fakes
import jax.numpy as jnp
import pytest
import stubs

from starjax.core import config
from starjax.data import normalizer
from starjax.policies import in_env, policy_file
from starjax.policies.base import Policy
from starjax.report import video

POLICY = dataclasses.replace(fakes.TINY, execute=4)


def unused(*_):
    pytest.fail("no test trains")


def stubbed(tmp_path, monkeypatch):
    """A policy's file in an empty folder, for the stub of a simulator and of networks."""
    network, params = stubs.make_policy()

    def sample(_, stats, keys, observation, trocar):
        return network(params, 1.0, keys, observation, trocar)

    policy = Policy(lambda key: params, unused, unused, sample)

    monkeypatch.setattr(in_env.sim_env, "make", lambda *_, **__: stubs.make_env())
    monkeypatch.setattr(in_env.policies, "make", lambda *_, **__: policy)
    monkeypatch.setattr(video, "record", lambda runs, path: path)
    monkeypatch.chdir(tmp_path)
    box = normalizer.MinMax(-jnp.ones(5), jnp.ones(5))
    made = fakes.trained(
        method="dp_rcm2",
        policy=POLICY,
        train=config.TrainConfig(steps=77),
        params={"learner": {"unet": {"kernel": jnp.ones(3)}}},
        normalizer=normalizer.Normalizer(box, None),
        demos=config.DemosConfig(per_trocar=2, seen_trocars=4),
        preset="smoke",
    )
    policy_file.save(tmp_path / "mine.safetensors", made)
    return tmp_path / "mine.safetensors"
