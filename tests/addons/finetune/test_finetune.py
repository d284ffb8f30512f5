"""`starjax finetune` as a whole, with stubs of the simulator and of the networks."""

import dataclasses
import itertools
import json
import types
from pathlib import Path

import fakes
import jax
import jax.numpy as jnp
import mistakes
import numpy as np
import pytest
import stubs

from starjax.addons.finetune import dagger
from starjax.addons.finetune.commands import (
    finetune,
    finetune_checks,
    finetune_page,
    finetune_stages,
    finetune_work,
)
from starjax.cli import policy_evaluation
from starjax.core import config
from starjax.core.registry import Registry
from starjax.core.types import Command, Pose
from starjax.data import normalizer, store
from starjax.policies import in_env, policy_file
from starjax.policies.base import Policy
from starjax.policies.learners.onestep import OnestepConfig
from starjax.policies.monitor import record, scores
from starjax.runtime import files
from starjax.sim import registries

HORIZON = fakes.TINY.horizon
TRAIN = config.TrainConfig(batch_size=8, learning_rate=0.5, holdout_demos=1, log_every=6)
DEMOS = config.DemosConfig(per_trocar=2, seen_trocars=4, max_steps=100)
TOO_SHORT = 0.93  # fraction of the path to a goal: near ones are reached


def goes(params, observation):
    goal = observation.state[:, -1, :3] * params["learner"]["scale"]
    return jnp.broadcast_to(goal[:, None, None], (len(goal), HORIZON, 1, 3))


def sample(params, stats, keys, observation, trocar):
    p = goes(params, observation)
    return Command(Pose(jnp.broadcast_to(jnp.eye(3), (*p.shape, 3)), p), jnp.ones(p.shape[:-1]))


def loss(params, prepared):
    observation, command = prepared
    return jnp.mean((goes(params, observation)[:, -1] - command.pose.p[:, -1]) ** 2), {}


def start():
    return {"learner": {"scale": jnp.full(3, TOO_SHORT)}}


def generate(params, stats, keys, observation, trocar):
    return goes(params, observation)[:, :, 0] / ACTION


def execute(params, stats, actions, observation, trocar):
    p = ACTION * actions[:, :, None]
    return Command(Pose(jnp.broadcast_to(jnp.eye(3), (*p.shape, 3)), p), jnp.ones(p.shape[:-1]))


ACTION = 0.1  # m, of an action of 1
POLICY = Policy(lambda key: start(), lambda stats, key, batch: (batch.observation, batch.command),
                loss, sample, generate=generate, execute=execute)  # fmt: skip


def make_env():
    env = stubs.make_env(unlucky=0.1)
    state = lambda bound, layout, measurements: jnp.tile(layout.goal[0], 4)  # noqa: E731
    task = env.task._replace(state=state, relative=fakes.relative)
    return env._replace(task=task, scene=types.SimpleNamespace(arms=(), bound=None))


@pytest.fixture
def file(tmp_path, monkeypatch):
    """A policy that stops short of its goals, with a monitor."""
    monkeypatch.setattr(in_env.sim_env, "make", lambda *_, **__: make_env())
    monkeypatch.setattr(in_env.policies, "make", lambda *_, **__: POLICY)
    times = {"p50": 1.0, "p95": 1.0, "p99": 1.0}
    monkeypatch.setattr(policy_evaluation, "inference_ms", lambda *_: times)
    # The stub's arm has no scene to draw.
    monkeypatch.setattr(finetune_page, "write", lambda out, content: out / str(content["best"]))
    rescuers = Registry("rescuer", {"reach": "stubs:RESCUER"})
    monkeypatch.setattr(registries, "rescuers", rescuers)
    monkeypatch.chdir(tmp_path)
    params = start()
    monitor = record.Monitor(
        settings=scores.ScoreSettings(8, 30.0, 6),
        alpha=0.05,
        count=100,
        threshold=2.0,
        center=np.zeros(len(scores.NAMES)),
        width=np.ones(len(scores.NAMES)),
        clock_s=7.9,
        digest=policy_file.monitor_digest(params),
    )
    box = normalizer.MinMax(-0.1 * jnp.ones(5), 0.1 * jnp.ones(5))
    made = fakes.trained(
        policy=dataclasses.replace(
            fakes.TINY,
            learner="onestep",
            options=OnestepConfig(unet_channels=(16,), time_dim=16, groups=4),
        ),
        params=params,
        normalizer=normalizer.Normalizer(box, None),
        train=TRAIN,
        demos=DEMOS,
        monitor=monitor,
    )
    policy_file.save(tmp_path / "mine.safetensors", made)
    return tmp_path / "mine.safetensors"


def tune(rounds=1, *more):
    flags = (
        f"--trials 6 --validation 6 --rounds {rounds} --steps 60 --eval.trials 2 --dtype float32"
    )
    limit = ["--eval.time-limit-s", "4", "--out", "tuned"]
    return finetune.main(["--policy", "mine.safetensors", *flags.split(), *limit, *more])


def outcome():
    return json.loads(Path("tuned/finetune.json").read_text())


@pytest.mark.slow
@pytest.mark.release
def test_a_policy_that_stops_short_learns_to_arrive(file, monkeypatch):
    assert tune() == 0
    out = Path("tuned")
    told = json.loads((out / "finetune.json").read_text())
    before, after = told["before"]["seen"], told["after"]["seen"]
    assert 0 < before["successes"] < after["successes"] and after["trials"] == 8
    assert [one["round"] for one in told["rounds"]] == [0, 1] and told["best"] == 1
    stored, new = (policy_file.load(path) for path in (file, out / "policy.safetensors"))
    assert stored.monitor is not None and new.monitor is None
    np.testing.assert_array_equal(new.normalizer.action.low, stored.normalizer.action.low)
    np.testing.assert_array_equal(new.normalizer.action.high, stored.normalizer.action.high)
    assert (new.params["learner"]["scale"] > TOO_SHORT).all()
    # The same command finds everything complete.
    monkeypatch.setattr(finetune_stages.loop, "run", lambda *_, **__: pytest.fail("trained again"))
    assert tune() == 0
    assert jax.tree.all(
        jax.tree.map(
            np.array_equal, policy_file.load(out / "policy.safetensors").params, new.params
        )
    )


@pytest.mark.slow
def test_a_fine_tuning_that_is_stopped_has_the_outcome_of_its_rounds(file, monkeypatch):
    run = finetune_stages.loop.run

    def stopped(*args, **kwargs):
        if "Round 2" in kwargs["description"]:
            raise KeyboardInterrupt("stopped")
        return run(*args, **kwargs)

    monkeypatch.setattr(finetune_stages.loop, "run", stopped)
    with pytest.raises(KeyboardInterrupt):
        tune(rounds=2)
    told = json.loads(Path("tuned/finetune.json").read_text())
    assert [one["round"] for one in told["rounds"]] == [0, 1] and told["best"] == 1
    assert told["after"]["seen"]["successes"] > told["before"]["seen"]["successes"]
    assert policy_file.load("tuned/policy.safetensors").monitor is None


def test_a_folder_of_other_settings_is_refused(file):
    Path("tuned").mkdir()
    Path("tuned/plan.json").write_text(json.dumps({"steps": 61}))
    with mistakes.of("steps", 60):
        tune()
    Path("tuned/plan.json").write_text(json.dumps({"weights": 64 * "0"}))
    with mistakes.of("RUN", files.sha256(file)[:12]):
        tune()


def test_a_task_without_such_an_expert_is_refused(file, monkeypatch):
    monkeypatch.setattr(registries, "rescuers", Registry("rescuer", {"other": "stubs:RESCUER"}))
    with mistakes.of("--by dagger", "reach"):
        tune()
    assert not Path("tuned/plan.json").exists()


@pytest.mark.parametrize("way", ["rl", "distill"])
def test_a_way_that_a_learner_does_not_permit_is_refused_before_anything_runs(file, way):
    stored = policy_file.load(file)
    act = config.with_learner(stored.policy, "act")
    policy_file.save(file, stored._replace(policy=act, monitor=None))
    with mistakes.of(f"--by {way}", "act"):
        tune(1, "--by", way)
    assert not Path("tuned/plan.json").exists()


def test_interventions_are_for_dagger_alone(file):
    with mistakes.of("--interventions", "--by rl"):
        tune(1, "--by", "rl", "--interventions", "nowhere")
    assert not Path("tuned/plan.json").exists()


def test_the_expert_of_a_given_dataset_is_that_which_takes_over(tmp_path):
    task = registries.tasks.get("needle_handover")
    given = config.RunConfig(demos=config.DemosConfig(from_=str(tmp_path)))
    assert finetune_checks.demonstrator(given, task) == ""  # loading the dataset names it
    for name, expert in (("wrist", "wrist"), ("operator", "")):
        store.create(tmp_path / name, {"schema": store.SCHEMA, "expert": name})
        given = config.RunConfig(demos=config.DemosConfig(from_=str(tmp_path / name)))
        assert finetune_checks.demonstrator(given, task) == expert
    own = config.RunConfig(demos=config.DemosConfig(expert="wrist"))
    assert finetune_checks.demonstrator(own, task) == "wrist"
    with mistakes.of("--by dagger", "needle_handover.wrist"):
        dagger.rescuer(task, "wrist")


RL = ("--by", "rl", "--iterations", "2", "--episodes", "20", "--noise", "0.02")


@pytest.mark.slow
def test_rounds_of_a_policy_gradient_go_on_with_what_the_critic_has_learned(file):
    assert tune(2, *RL) == 0
    first, second = outcome()["rounds"][1:]
    assert [row["noise"] for row in first["noise_levels"]] == [0.0, 0.005, 0.01, 0.02, 0.04]
    assert all(row["trials"] == 4 for row in first["noise_levels"])
    steps = [row["steps"] for part in (first, second) for row in part["iterations"]]
    assert steps[0] == 0 and all(count > 0 for count in steps[1:])  # the critic learns alone once
    assert second["noise"] == first["noise"] and "noise_levels" not in second


@pytest.mark.slow
def test_a_policy_gradient_whose_time_is_up_has_an_outcome(file, monkeypatch):
    calls = itertools.count()
    monkeypatch.setattr(finetune_work.Work, "is_late", lambda work: next(calls) > 1)
    assert tune(3, *RL, "--minutes", "5") == 0
    (_, only) = outcome()["rounds"]
    assert len(only["iterations"]) == 1 and only["validation"]["trials"] == 24
    assert Path("tuned/policy.safetensors").exists()


@pytest.mark.slow
def test_no_round_begins_when_the_time_is_up(file):
    assert tune(1, "--minutes", "1e-9") == 0
    assert len(outcome()["rounds"]) == 1 and outcome()["best"] == 0
    assert tune() == 0  # with more time, another round
    assert len(outcome()["rounds"]) == 2
