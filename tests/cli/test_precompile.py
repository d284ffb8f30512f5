"""A run compiles, before it has weights, the programs that it runs once it has them."""

import dataclasses
from typing import Any

import jax
import numpy as np
import pytest
import stubs
from fakes import TASK, TINY, dataset, relative, trained

from starjax.cli import demonstrations, pipeline, policy_evaluation, precompile, stage_times
from starjax.core import config
from starjax.core.methods import METHODS
from starjax.data import normalizer
from starjax.policies import generator, in_env, policy_file
from starjax.policies import policy as policies
from starjax.runtime import precompile as programs
from starjax.sim.rollouts import sharing
from starjax.training import encoder, loop

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
    chosen = {}
    select = programs.Program.select

    def noted(program, *args):
        executable = select(program, *args)
        chosen[name_of(program)] = executable != program._call
        return executable

    monkeypatch.setattr(programs.Program, "select", noted)
    who, found = scored("ahead", policy)
    assert len(found.steps) == 12
    jax.tree.map(np.testing.assert_array_equal, found, usual)
    assert policy_evaluation.inference_ms(who)["n"] >= 5
    assert chosen == {"start": True, "advance": True, "draw_inputs": False, "infer": True}


def test_an_error_ends_no_run(monkeypatch):
    monkeypatch.setattr(policy_evaluation, "precompile", lambda *_: 1 / 0)
    found = precompile.begin(config.RunConfig(), "stardiff", pipeline.STAGES, environment(), None)
    assert found.policy() is None
    found = precompile.begin(config.RunConfig(), "stardiff", ["collect"], environment(), None)
    assert found.step() is None and found.policy() is None


@pytest.mark.slow
@pytest.mark.release
def test_it_counts_for_no_stage(tmp_path):
    program = programs.Program(lambda x: x * 3.25)
    with stage_times.timed(tmp_path, "collect"):
        programs.start(lambda: program.prepare(1.0))()
    assert stage_times.read(tmp_path)["collect: compile"] == 0.0


@pytest.mark.release
def test_features_and_steps_are_compiled_before_the_demonstrations_exist(tmp_path, monkeypatch):
    env = stubs.make_env("image", unlucky=0.0)
    env = env._replace(camera=larger(env.camera), draw=larger(env.draw))
    policy = dataclasses.replace(TINY, observation="image", image_size=24, freeze_encoder=True)
    settings = config.RunConfig(
        scene=config.SceneConfig(camera=env.names.cameras),
        policy=policy,
        train=config.TrainConfig(steps=2, batch_size=8, holdout_demos=1),
        demos=config.DemosConfig(per_trocar=2, seen_trocars=2),
        out=str(tmp_path),
    )
    params = generator.vision_encoder(policy).init(jax.random.key(0), np.zeros((1, 24, 24, 3)))
    frozen = encoder.Encoder(params, "none")
    step = precompile.begin(settings, "stardiff", ["collect", "train"], env, frozen).step()
    compiled = []
    monkeypatch.setattr(
        programs.Program, "prepare", lambda program, *_: compiled.append(name_of(program))
    )
    call = programs.Program._call

    def noted(program, *args):
        compiled.append(name_of(program))
        return call(program, *args)

    monkeypatch.setattr(programs.Program, "_call", noted)
    root, collect, _ = demonstrations.plan(settings, env, sharing.ALONE)
    dataset = demonstrations.load(settings, env, root, collect, frozen, sharing.ALONE)
    assert len(dataset.episode) == demonstrations.size(settings, env.task)[1]
    monkeypatch.setattr(loop.holdout, "make", lambda *_: None)
    cameras = {"cameras": env.names.cameras, "step_program": step}
    given = METHODS["stardiff"], policy, settings.train, dataset, env.task, tmp_path / "stardiff", 0
    assert int(loop.run(*given, **cameras).state.step) == 2
    # Those of collecting, for which `DemosWork.precompile` was not called, of the first state, and
    # of a log line's learning rate.
    assert set(compiled) == {"start", "advance", "init", "create", "schedule"}


def larger(look: Any) -> Any:
    """Images of 24 pixels: the encoder needs more than the 6 of a stub."""

    def looks(state: Any) -> Any:
        return {name: image.replace(rgb=tile(image.rgb)) for name, image in look(state).items()}

    return looks


def tile(image: Any) -> Any:
    return jax.numpy.tile(image, (4, 4, 1))


def name_of(program: Any) -> str:
    return program._function.__name__
