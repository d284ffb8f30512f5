"""A run compiles, before it has weights, the programs that it runs once it has them."""

from typing import Any

import jax
import numpy as np
import pytest
import stubs
from fakes import TASK, TINY, dataset, relative, trained

from starjax import config
from starjax.commands import pipeline, policy_evaluation, precompile, stage_times
from starjax.data import normalizer
from starjax.methods import METHODS
from starjax.policies import in_env, policy_file
from starjax.policies import policy as policies
from starjax.runtime import precompile as programs

EVAL = config.EvalConfig(trials=1, time_limit_s=0.5, video_trials=1)


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


def test_weights_that_come_later_meet_their_programs(tmp_path, monkeypatch):
    env, name = environment(), "stardiff"
    row = METHODS[name]
    settings = config.RunConfig(method=name, preset="smoke", policy=TINY, eval=EVAL)
    stats = normalizer.fit(row, env.task, dataset(seed=0, demos=4, length=20), np.arange(80))
    params = jax.jit(policies.make(row, TINY, env.task).init)(jax.random.key(0))
    made = trained(params=params, normalizer=stats, scene=env.names)
    policy_file.save(tmp_path / "policy.safetensors", made)

    def scored(folder, policy):
        file = tmp_path / "policy.safetensors"
        who = in_env.place(file, policy_evaluation.read(file), env, method=name, policy=policy)
        place = tmp_path / folder
        found = policy_evaluation.rollouts(place, who, env.task.trocars, EVAL, settings.seed)
        return who, found

    _, usual = scored("usual", None)
    policy = precompile.begin(settings, name, pipeline.STAGES, env, None).policy()
    chosen = []
    select = programs.Program.select

    def noted(program, *args):
        executable = select(program, *args)
        chosen.append(executable != program._call)
        return executable

    monkeypatch.setattr(programs.Program, "select", noted)
    who, found = scored("ahead", policy)
    assert len(found.steps) == 12
    jax.tree.map(np.testing.assert_array_equal, found, usual)
    assert policy_evaluation.inference_ms(who)["n"] >= 5
    assert all(chosen) and len(chosen) >= 3


def test_an_error_ends_no_run(monkeypatch):
    monkeypatch.setattr(policy_evaluation, "precompile", lambda *_: 1 / 0)
    found = precompile.begin(config.RunConfig(), "stardiff", pipeline.STAGES, environment(), None)
    assert found.policy() is None
    found = precompile.begin(config.RunConfig(), "stardiff", ["collect"], environment(), None)
    assert found.step() is None and found.policy() is None


@pytest.mark.slow
def test_it_counts_for_no_stage(tmp_path):
    program = programs.Program(lambda x: x * 3.25)
    with stage_times.timed(tmp_path, "collect"):
        programs.start(lambda: program.prepare(1.0))()
    assert stage_times.read(tmp_path)["collect: compile"] == 0.0
