"""Demonstrations of a run: the requested ones."""

import dataclasses

import mistakes
import numpy as np
import pytest
import stubs

from starjax.cli import demonstrations, presets
from starjax.core import config, errors
from starjax.sim import registries
from starjax.sim.rollouts import sharing

SMOKE = presets.PRESETS["smoke"]


def test_too_few_steps_for_the_expert_name_the_setting(tmp_path, monkeypatch):
    from starjax.data import demos
    from starjax.sim.rollouts import success_quota

    def collect(*_, **settings):
        raise success_quota.ExpertFailed("got 0 of 10 at trocar 0")

    monkeypatch.setattr(demos, "collect", collect)
    few = dataclasses.replace(SMOKE.demos, max_steps=1)
    tried = dataclasses.replace(SMOKE, demos=few, out=str(tmp_path))
    _, missing, _ = demonstrations.plan(tried, stubs.make_env(), sharing.ALONE)
    with mistakes.of("demos.max_steps", 1) as caught:
        missing()
    assert "0 of 10" in caught.value.hint


def test_an_expert_that_fails_for_its_tasks_draws_is_a_mistake_of_the_draws(tmp_path, monkeypatch):
    from starjax.data import demos
    from starjax.sim import task_draws
    from starjax.sim.rollouts import success_quota

    def collect(*_, **settings):
        raise success_quota.ExpertFailed("got 0 of 10 at trocar 0")

    monkeypatch.setattr(demos, "collect", collect)
    draws = iter([("label", "is not finite at [0]")])
    monkeypatch.setattr(task_draws, "faults", lambda scene: draws)
    monkeypatch.delitem(registries.tasks.built_in, "reach")  # as of another package
    env = stubs.make_env()
    env.scene.task = env.task
    _, missing, _ = demonstrations.plan(
        dataclasses.replace(SMOKE, out=str(tmp_path)), env, sharing.ALONE
    )
    with pytest.raises(errors.UsageError) as caught:
        missing()
    assert caught.value.argument.startswith("task reach: label (stubs.py:")


@pytest.mark.parametrize(("seen", "expert", "least"), [(1, "one_wall", 0), (8, "", 6), (2, "", 9)])
def test_demonstrations_are_those_that_were_asked_for(tmp_path, monkeypatch, seen, expert, least):
    from starjax import rcm
    from starjax.data import demos

    given = []
    found = {"episodes": 0, "trials": 0, "frames": 0}
    monkeypatch.setattr(demos, "collect", lambda *a, **_: given.append(a) or found)
    asked = config.DemosConfig(per_trocar=3, seen_trocars=seen, max_steps=7, expert=expert)
    chosen = dataclasses.replace(SMOKE, demos=asked, seed=5, out=str(tmp_path))
    env = stubs.make_env()
    env = env._replace(task=env.task._replace(least_steps=least))
    demonstrations.plan(chosen, env, sharing.ALONE)[1]()
    ((_, _, _, trocars, settings),) = given
    np.testing.assert_array_equal(trocars, [field[:seen, None] for field in rcm.TROCARS])
    wanted = {"per_trocar": 3, "seed": 5, "max_steps": max(7, least)}
    wanted |= {"expert": expert or "default"}
    assert {name: settings._asdict()[name] for name in wanted} == wanted


def test_another_version_of_the_expert_asks_for_new_demonstrations(tmp_path):
    chosen, env = dataclasses.replace(SMOKE, out=str(tmp_path)), stubs.make_env()
    before = demonstrations.plan(chosen, env, sharing.ALONE).root
    assert demonstrations.plan(chosen, env, sharing.ALONE).root == before
    raised = env._replace(task=env.task._replace(expert_version=2))
    assert demonstrations.plan(chosen, raised, sharing.ALONE).root != before


def test_an_expert_that_the_task_lacks_is_a_mistake(tmp_path):
    asked = dataclasses.replace(SMOKE.demos, expert="two_walls")
    with mistakes.of("demos.expert", "two_walls"):
        demonstrations.plan(
            dataclasses.replace(SMOKE, demos=asked), stubs.make_env(), sharing.ALONE
        )


def test_demonstrations_are_recorded_with_what_is_wrong(tmp_path, monkeypatch):
    import jax

    from starjax.data import demos, schema
    from starjax.sim.state import EnvParams

    given = []
    found = {"episodes": 0, "trials": 0, "frames": 0}
    monkeypatch.setattr(demos, "collect", lambda *a, **_: given.append(a) or found)
    seen = dataclasses.replace(SMOKE.policy, observation="image")
    env, roots = stubs.make_env("image"), []
    for wrong in ((), ("action_delay=2",), ("action_delay=1",)):
        asked = dataclasses.replace(SMOKE.demos, randomise=wrong)
        chosen = dataclasses.replace(SMOKE, demos=asked, policy=seen, out=str(tmp_path))
        root, collect, _ = demonstrations.plan(chosen, env, sharing.ALONE)
        collect()
        roots.append(root)
    assert len(set(roots)) == 3
    # Images are drawn in training, from the state, also if the motion is disturbed.
    recorded = [schema.describe(asked[1], *asked[3:]) for asked in given]
    assert not any("image_camera" in about["features"] for about in recorded)
    assert "randomise" not in schema.describe(env, *given[0][3:])
    assert schema.describe(env, *given[1][3:])["randomise"] == {"late_commands": 2}
    params = EnvParams(jax.tree.map(lambda x: x[0], stubs.trocars(4)))
    state = given[1][1].reset(jax.random.key(0), params)
    assert set(state.wrapper_state) == {"action_delay"}


def test_recorded_disturbances_leave_displaced_cameras_to_the_training(tmp_path):
    policy = dataclasses.replace(SMOKE.policy, observation="image")
    demos = dataclasses.replace(SMOKE.demos, randomise=("action_delay=2",))
    train = dataclasses.replace(SMOKE.train, randomise=("camera=10",))
    chosen = dataclasses.replace(SMOKE, demos=demos, policy=policy, train=train, out=str(tmp_path))
    assert demonstrations.plan(chosen, stubs.make_env("image"), sharing.ALONE).root


@pytest.mark.parametrize(
    ("observation", "wrong", "got"),
    [
        ("image", "trocar_offset=2", "trocar_offset"),
        ("image", "breathing=2", "breathing"),
        ("image", "action_delay=5", 5),
        ("image", "smoke=0.5", "smoke"),
        ("image", "camera=5", "camera"),
        ("state", "observation_delay=2", "observation_delay"),
        ("image", "observation_dropout=0.3", "observation_dropout"),
    ],
)
def test_what_demonstrations_cannot_show_is_refused(tmp_path, observation, wrong, got):
    asked = dataclasses.replace(SMOKE.demos, randomise=(wrong,))
    seen = dataclasses.replace(SMOKE.policy, observation=observation)
    chosen = dataclasses.replace(SMOKE, demos=asked, policy=seen, out=str(tmp_path))
    with mistakes.of("demos.randomise", got):
        demonstrations.plan(chosen, stubs.make_env(observation), sharing.ALONE)
