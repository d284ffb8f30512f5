"""What a run compiles before it has weights is what it runs once it has them."""

from typing import Any

import jax
import numpy as np
import pytest
import stubs
from fakes import TASK, TINY, dataset, relative, trained
from jax.experimental.compilation_cache import compilation_cache

from starjax import config
from starjax.data import normalizer
from starjax.experiments import pipeline, policy_under_test, presets, stage_times
from starjax.methods import METHODS
from starjax.policies import policy as policies
from starjax.policies import policy_file
from starjax.runtime import background

EVAL = config.EvalConfig(trials=1, time_limit_s=0.5, video_trials=1)


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache of compiled programs; gives how many of them advance a batch of trials."""
    before = jax.config.jax_compilation_cache_dir
    folder = tmp_path / "cache"
    jax.config.update("jax_compilation_cache_dir", str(folder))
    compilation_cache.reset_cache()
    yield lambda: len([path for path in folder.glob("jit_advance-*") if path.suffix != ".atime"])
    jax.config.update("jax_compilation_cache_dir", before)
    compilation_cache.reset_cache()


def environment() -> Any:
    env = stubs.make_env()
    return env._replace(task=env.task._replace(relative=relative))


@pytest.mark.parametrize("name", ["stardiff", "dp_rcm2", "dp_ee"])
@pytest.mark.parametrize("state", [True, False])
def test_shapes_of_statistics_are_those_of_fitted_ones(name, state):
    demos = dataset(seed=0, demos=2, length=5)
    if not state:
        demos = demos.replace(observation=demos.observation._replace(state=None))
    fitted = normalizer.fit(METHODS[name], TASK, demos, np.arange(10))
    shapes = normalizer.shapes(METHODS[name], TASK, state)
    assert jax.tree.map(lambda x: (x.shape, x.dtype), fitted) == jax.tree.map(
        lambda x: (x.shape, x.dtype), shapes
    )


def test_weights_that_come_later_meet_their_program(tmp_path, cache):
    env, name = environment(), "stardiff"
    row = METHODS[name]
    settings = config.RunConfig(method=name, preset="smoke", policy=TINY, eval=EVAL)
    stats = normalizer.fit(row, env.task, dataset(seed=0, demos=4, length=20), np.arange(80))
    params = jax.jit(policies.make(row, TINY, env.task).init)(jax.random.key(0))
    made = trained(params=params, normalizer=stats, scene=env.names)
    policy_file.save(tmp_path / "policy.safetensors", made)

    policy_under_test.compile_ahead(name, settings, env, None)
    assert cache() == 1
    who = policy_under_test.load(name, tmp_path / "policy.safetensors", env)
    found = policy_under_test.rollouts(tmp_path / "out", who, env.task.trocars, EVAL, settings.seed)
    assert len(found.steps) == 12 and cache() == 1


def test_it_counts_for_no_stage(tmp_path):
    def work():
        with stage_times.apart():
            jax.jit(lambda x: x * 3.25).lower(1.0).compile()

    with stage_times.timed(tmp_path, "collect"):
        background.run_in_background(work)()
    assert stage_times.read(tmp_path)["collect: compile"] == 0.0


def test_without_a_cache_nothing_is_compiled_ahead(cache):
    jax.config.update("jax_compilation_cache_dir", None)
    smoke = presets.PRESETS["smoke"]
    assert pipeline._compiling_ahead(smoke, "stardiff", environment(), None) is None
