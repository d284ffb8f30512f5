"""An endoscope's pose on its way: episode, dataset, training windows; trials, trajectories."""

import jax
import mistakes
import numpy as np
import pytest
import stubs

from starjax.cli import demonstrations
from starjax.core import config
from starjax.data import demos, load, schema
from starjax.evaluation import evaluate, recorded
from starjax.sim import endoscope_camera, workspaces
from starjax.sim.rollouts import agent
from starjax.sim.rollouts.placement import DeviceLayout

SCOPE = workspaces.BOARD_ENDOSCOPE


def make_env():
    """The stub, seen through an endoscope."""
    env = stubs.make_env("image", unlucky=0.0, cameras=(endoscope_camera.NAME,))

    def reset(key, params):
        return env.reset(key, params).replace(endoscope=endoscope_camera.draw(SCOPE, key))

    return env._replace(
        reset=reset,
        observe=lambda state: env.observe(state)._replace(endoscope=state.endoscope),
        task=env.task._replace(endoscope=SCOPE, cameras=(endoscope_camera.NAME,)),
    )


def collected(root, env):
    settings = schema.DemoSettings(per_trocar=2, seed=0, max_steps=100)
    expert, layout = agent.from_single(stubs.EXPERT), DeviceLayout(lanes=4)
    demos.collect(root, env, expert, stubs.trocars(0, 8), settings, layout=layout)
    return root


@pytest.fixture(scope="module")
def seen(tmp_path_factory):
    return collected(tmp_path_factory.mktemp("seen") / "d", make_env())


def test_demonstrations_tell_it(seen):
    dataset = load.load(seen, residency="host").dataset
    held = dataset.observation.endoscope
    first = np.asarray(held.p)[np.asarray(dataset.start)]
    np.testing.assert_array_equal(held.p, first[np.asarray(dataset.episode)])
    assert len(np.unique(first, axis=0)) == len(first) == 4


def test_demonstrations_that_were_seen_otherwise_are_refused(seen, tmp_path):
    policy = config.PolicyConfig(image_size=6)

    def asked(root):
        return config.RunConfig(policy=policy, demos=config.DemosConfig(from_=str(root)))

    assert demonstrations.given(asked(seen), make_env()) == seen
    fixed = stubs.make_env("image", unlucky=0.0)
    with mistakes.of("demos.from_"):
        demonstrations.given(asked(seen), fixed)
    with mistakes.of("demos.from_"):
        demonstrations.given(asked(collected(tmp_path / "d", fixed)), make_env())


def test_trajectories_have_it(tmp_path):
    env, expert = make_env(), agent.from_single(stubs.EXPERT)
    settings = evaluate.EvaluationSettings(trials=2, seed=0, time_limit_s=2.0, video_trials=2)
    run = lambda: evaluate.evaluate(  # noqa: E731
        tmp_path, env, expert, (), stubs.trocars(0, 8), settings, layout=DeviceLayout(lanes=4)
    )
    run()
    kept = recorded.read(tmp_path / "recorded.npz")
    assert len(kept) == 2
    for track in kept:
        assert track.endoscope.R.shape == (len(track.qpos), 3, 3)
        np.testing.assert_array_equal(
            track.endoscope.p, np.tile(track.endoscope.p[:1], (len(track.qpos), 1))
        )
    assert (kept[0].endoscope.p[0] != kept[1].endoscope.p[0]).any()
    before = jax.tree.leaves(kept[0].endoscope)
    run()  # the chunks are those of the same plan, and are read as whole
    again = recorded.read(tmp_path / "recorded.npz")
    np.testing.assert_array_equal(before[1], again[0].endoscope.p)
