"""Takeovers before the progress ended: the branches of a trial, and the learned one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stubs

from starjax.addons.finetune import dagger, rounds
from starjax.addons.finetune.commands import finetune_counts
from starjax.core.types import Command, Pose
from starjax.data import store
from starjax.sim.rescuer import Rescuer
from starjax.sim.rollouts import agent, episodes, takeover
from starjax.sim.rollouts.placement import DeviceLayout

HZ, PROGRESSED, STALLED = 30.0, 130, 40
TROCARS = stubs.trocars(0, 8)
SETTINGS = rounds.RoundSettings(0, 3, 6, 240, "", "digest", {})


def gains_until_then():
    """The stub with a reward that grows up to a step, for any tip."""
    env = stubs.make_env(unlucky=0.0)

    def step(state, command):
        after = env.step(state, command)
        return after.replace(reward=jnp.minimum(after.step, PROGRESSED) / 40.0)

    return env._replace(step=step)


def latest(goal):
    """The last step from which the expert reaches a goal `[..., 3]`."""
    return jnp.where(goal[..., 0] > 0, 80, jnp.where(goal[..., 1] > 0, 20, -1))


def resume(key, state):
    return key, state.step <= latest(state.layout.goal[0])


def act(memory, state):
    key, can = memory
    command, key, label = stubs.EXPERT.act(key, state)
    stays = Command(state.pose, state.gripper)
    either = jax.tree.map(lambda x, y: jnp.where(can, x, y), (command, label), (stays, stays))
    return either[0], (key, can), either[1]


def jitters(params, stats, keys, observation, trocar):
    """A policy that goes nowhere, by its noise."""
    noise = jax.vmap(lambda key: 1e-3 * jax.random.normal(key, (4, 1, 3)))(keys)
    p = jnp.array([0.0, 0.0, 0.02]) + noise
    return Command(Pose(jnp.broadcast_to(jnp.eye(3), (*p.shape, 3)), p), -jnp.ones(p.shape[:-1]))


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """The folder of a round, its outcomes and all episodes by trial."""
    root, found = tmp_path_factory.mktemp("round") / "rollouts", {}

    def choose(runs):
        found[runs[0].trial] = runs
        return dagger.chosen(runs, 2)

    way = rounds.Way(
        source=takeover.INTERVENTION,
        agent=takeover.from_policy(agent.from_policy(jitters, 2, 4), Rescuer(resume, act)),
        params=lambda clocks: ((None, None), takeover.TakeoverLimits(clocks, np.int32(STALLED))),
        runs=(220,),
        record=takeover.RECORDS["state"],
        choose=choose,
        cause=lambda runs: dagger.cause(runs[0]),
        again=lambda runs: dagger.earlier(runs[0], HZ),
    )
    layout = DeviceLayout(lanes=5)
    env = gains_until_then()
    outcomes = rounds.collect(root, env, TROCARS, way, SETTINGS, layout=layout, report=print)
    return root, outcomes, found


def test_the_latest_branch_that_the_expert_rescues_is_learned(played):
    root, outcomes, found = played
    trials = zip(outcomes.trocar.tolist(), outcomes.trial.tolist(), strict=True)
    goals = np.array([found[trial][0].joined("state")[0, :3] for trial in trials])
    limit = np.asarray(latest(goals))
    want = np.select([limit == 80, limit == 20], [2, 3], -1)
    np.testing.assert_array_equal(outcomes.run, want)
    assert set(want) == {-1, 2, 3} and set(outcomes.cause) == {"stalled"}
    np.testing.assert_array_equal(outcomes.kept, want > 0)
    records = [store.verify(root, key) for key in store.keys(root)]
    assert len(records) == outcomes.kept.sum() and all(record["success"] for record in records)
    steps = {record["rewound"]: record["step"] for record in records}
    assert steps == {2: PROGRESSED - 60, 3: PROGRESSED - 120}
    for record in records:
        actor = np.load(root / "episodes" / record["key"] / "actor.npy")
        assert record["first"] == record["step"] - 1 and record["cause"] == "stalled"
        np.testing.assert_array_equal(actor, np.arange(record["length"]) > 0)


def test_a_branch_is_the_same_trial_up_to_the_takeover(played):
    for runs in played[2].values():
        assert len(runs) == 4 and runs[0].joined("cause").argmax() > PROGRESSED
        for run, back in zip(runs[1:], dagger.REWINDS_S, strict=True):
            step = PROGRESSED - round(back * HZ)
            assert run.joined("cause").argmax() == step
            for name in ("p", "state", "command_p", "command_gripper"):
                np.testing.assert_array_equal(run.joined(name)[:step], runs[0].joined(name)[:step])


def test_the_summary_names_the_trials_that_no_branch_rescues(played):
    _, outcomes, _ = played
    told = finetune_counts.report(outcomes)
    assert told["branches"]["takeover"] == told["branches"]["1 s"] == 0
    assert sum(told["branches"].values()) == outcomes.kept.sum()
    left = np.flatnonzero(~outcomes.kept)
    pairs = [[int(outcomes.trocar[i]), int(outcomes.trial[i])] for i in left]
    assert told["not_rescued"] == {"stalled": pairs}
    assert told["takeovers"]["stalled"]["successes"] == 0


def ended(length, progressed, success=False, **flags):
    """An episode in which no signal fired."""
    numbers = {takeover.CAUSE: 0, takeover.PROGRESSED: progressed}
    flags = {**dict.fromkeys(episodes.FLAGS, False), "success": success, **flags}
    return episodes.Episode(flags, {name: [np.full(length, n)] for name, n in numbers.items()})


def test_a_loss_that_no_signal_announced_is_branched_too():
    lost = ended(90, 80, lost=True)
    assert dagger.cause(lost) == "lost" and dagger.earlier(lost, HZ) == [50, 20, 0]
    assert dagger.earlier(ended(20, 10, invalid=True), HZ) == [0]  # no earlier step
    assert dagger.earlier(ended(90, 80, success=True), HZ) == []
    assert dagger.cause(ended(90, 80, success=True)) == "none"
