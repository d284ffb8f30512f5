"""Commands, losses and statistics as they were before arms had an axis, from stored arrays."""

import dataclasses
import json
import pathlib

import fakes
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax.core import config
from starjax.core.methods import METHODS
from starjax.data import normalizer, windows
from starjax.policies import policy as policies

GOLDEN = pathlib.Path(__file__).parents[1] / "golden"
METHODS_BEFORE = json.loads((GOLDEN / "methods.json").read_text())


def jit(fn):
    # these programs run once: compiling them badly is fast
    return jax.jit(fn, compiler_options={"xla_backend_optimization_level": 0})


OTHERS = {"dp_ee_proj state", "dp_rcm1 image"}  # before a release


@pytest.mark.parametrize(
    "row",
    [pytest.param(x, marks=[pytest.mark.release] if x in OTHERS else []) for x in METHODS_BEFORE],
)
def test_parameters_losses_and_samples_of_one_arm_are_what_they_were(row):
    before, (name, kind) = METHODS_BEFORE[row], row.split()
    sees = kind == "image"
    settings = dataclasses.replace(fakes.TINY, observation=kind, roll_observation=sees)
    policy = policies.make(METHODS[name], settings, fakes.TASK, config.TrainConfig())
    size = settings.image_size if sees else 0
    dataset = fakes.drawn(seed=0, demos=4, length=20, image_size=size, arms=1)
    stats = normalizer.fit(METHODS[name], fakes.TASK, dataset, np.arange(60))
    np.testing.assert_allclose(stats.action.low, before["low"], rtol=1e-5, atol=1e-6)
    assert (stats.action.reach is None) == (before["reach"] is None)
    if before["reach"]:
        np.testing.assert_allclose(stats.action.reach, before["reach"], rtol=1e-5, atol=1e-5)

    params = jax.tree.map(lambda x: x + 0.01, jit(policy.init)(jax.random.key(5)))
    leaves = [np.asarray(leaf, np.float64) for leaf in jax.tree.leaves(params)]
    weights = sum(np.abs(leaf).sum() for leaf in leaves)
    assert weights == pytest.approx(before["weights"], rel=1e-7)

    batch = windows.gather(dataset, jnp.array([3, 25, 70]), 2, 16)
    prepared = jit(policy.prepare)(stats, jax.random.key(6), batch)
    loss, parts = jit(policy.loss)(params, prepared)
    found = {"loss": float(loss), **{name: float(part) for name, part in parts.items()}}
    assert found == pytest.approx({"loss": before["loss"], **before["parts"]}, rel=1e-4)

    keys = jax.random.split(jax.random.key(1), 3)
    said = jit(policy.sample)(params, stats, keys, batch.observation, batch.trocar)
    np.testing.assert_allclose(said.pose.p[:, ::5, 0], before["p"], atol=1e-6)
    np.testing.assert_allclose(said.pose.R[:, ::5, 0, :2, 0], before["R"], atol=1e-5)
    np.testing.assert_allclose(said.gripper[:, ::5, 0], before["gripper"], atol=1e-5)
