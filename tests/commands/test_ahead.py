"""What a run compiles before it has weights is what it runs once it has them."""

from typing import Any

import jax
import numpy as np
import pytest
import stubs
from fakes import TASK, TINY, dataset, relative, trained

from starjax import config
from starjax.commands import ahead, pipeline, policy_evaluation, stage_times
from starjax.data import normalizer
from starjax.methods import METHODS
from starjax.policies import policy as policies
from starjax.policies import policy_file
from starjax.rollouts import engine
from starjax.runtime import background
from starjax.training import ahead as training

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


def test_weights_that_come_later_meet_their_program(tmp_path, monkeypatch):
    env, name = environment(), "stardiff"
    row = METHODS[name]
    settings = config.RunConfig(method=name, preset="smoke", policy=TINY, eval=EVAL)
    stats = normalizer.fit(row, env.task, dataset(seed=0, demos=4, length=20), np.arange(80))
    params = jax.jit(policies.make(row, TINY, env.task).init)(jax.random.key(0))
    made = trained(params=params, normalizer=stats, scene=env.names)
    policy_file.save(tmp_path / "policy.safetensors", made)

    # In a thread, beside another program that is traced: what a run does.
    compiled = ahead.begin(settings, name, pipeline.STAGES, env, None).evaluation()
    who = policy_evaluation.load(name, tmp_path / "policy.safetensors", env)

    def scored(folder, **given):
        wanted = (tmp_path / folder, who, env.task.trocars, EVAL, settings.seed)
        return policy_evaluation.rollouts(*wanted, **given)

    usual = scored("usual")
    monkeypatch.setattr(engine.programs, "make", None)
    found = scored("ahead", compiled=compiled.trials)
    assert len(found.steps) == 12
    jax.tree.map(np.testing.assert_array_equal, found, usual)
    other = compiled.trials._replace(settings=compiled.trials.settings._replace(lanes=1))
    with pytest.raises(TypeError, match="not callable"):  # programs of its own are made
        scored("others", compiled=other)

    # Its own program may not be made.
    monkeypatch.setattr(policy_evaluation.latency, "_program", None)
    assert policy_evaluation.inference_ms(who, compiled.decision)["n"] >= 5


def test_a_mistake_ends_no_run(monkeypatch):
    monkeypatch.setattr(training, "compile_step", lambda *_: 1 / 0)
    monkeypatch.setattr(policy_evaluation, "compile_ahead", lambda *_: "evaluation")
    found = ahead.begin(config.RunConfig(), "stardiff", pipeline.STAGES, environment(), None)
    assert found.step() is None and found.evaluation() == "evaluation"
    found = ahead.begin(config.RunConfig(), "stardiff", ["collect"], environment(), None)
    assert found.step() is None and found.evaluation() is None


def test_it_counts_for_no_stage(tmp_path):
    def work():
        with stage_times.apart():
            jax.jit(lambda x: x * 3.25).lower(1.0).compile()

    with stage_times.timed(tmp_path, "collect"):
        background.run_in_background(work)()
    assert stage_times.read(tmp_path)["collect: compile"] == 0.0
