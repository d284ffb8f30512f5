"""Errors on demonstrations that were kept out."""

import types
from typing import Any

import fakes
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax import rcm
from starjax.core.types import Command, Pose
from starjax.policies.base import Policy
from starjax.training import holdout


def test_the_average_is_what_is_judged():
    def sample(params, stats, keys, observation, trocar):
        last = observation.pose.p[:, -1:]
        p = jnp.broadcast_to(last + params, (len(keys), fakes.TINY.horizon, 1, 3))
        return Command(Pose(observation.pose.R[:, -1:], p), observation.gripper[:, -1:])

    nothing: Any = None
    dataset = fakes.dataset(seed=0, demos=2, length=20)
    policy = Policy(nothing, nothing, nothing, sample)
    holdout_error = holdout.make(policy, fakes.TINY, dataset, np.arange(20, 40))
    assert holdout_error

    def errors(raw, average):
        state: Any = types.SimpleNamespace(
            params=jnp.float32(raw), ema_params=jnp.float32(average), normalizer=None
        )
        return holdout_error(state)

    assert errors(0.0, 1.0) == errors(5.0, 1.0) != errors(1.0, 0.0)


def test_errors_are_in_their_units_and_rolls_go_round_the_circle():
    def command(x, roll_deg, gripper):
        pose = Pose(rcm.rotation_z(jnp.deg2rad(roll_deg)), jnp.array([x, 0.0, 0.0]))
        return Command(pose, jnp.float32(gripper))

    port = jnp.array([0.0, 0.004, 0.1])  # points 5 and 4 mm from a shaft along z
    found = holdout.action_errors(command(0.003, 179.0, 1.0), command(0.0, -179.0, -1.0), port)
    wanted = {"position_error_mm": 3.0, "roll_error_deg": 2.0, "gripper_error": 2.0}
    wanted["rcm_error_mm"] = 5.0
    assert {name: float(value) for name, value in found.items()} == pytest.approx(wanted, rel=1e-3)
    turned = holdout.action_errors(command(0.0, -179.0, -1.0), command(0.003, 179.0, 1.0), port)
    wanted["rcm_error_mm"] = 4.0
    assert {name: float(value) for name, value in turned.items()} == pytest.approx(wanted, rel=1e-3)


def test_windows_are_spread_over_all_that_is_kept_out(monkeypatch):
    asked, gather = [], holdout.windows.gather
    monkeypatch.setattr(
        holdout.windows, "gather", lambda d, f, *a: asked.append(np.asarray(f)) or gather(d, f, *a)
    )
    nothing: Any = None
    dataset = jax.tree.map(np.asarray, fakes.dataset(seed=0, demos=8, length=20))
    holdout.make(Policy(*[nothing] * 4), fakes.TINY, dataset, np.arange(32, 160))
    np.testing.assert_array_equal(asked, [np.arange(32, 160, 2)])
