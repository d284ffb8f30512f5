"""A person relieves a policy: the actor is recorded, and fine-tuning learns the episode."""

import jax.numpy as jnp
import mistakes
import numpy as np
import pytest
import stubs

from starjax import rcm
from starjax.addons.finetune import mixing
from starjax.addons.finetune.commands import interventions
from starjax.addons.finetune.settings import FinetuneConfig
from starjax.addons.viewer import recorder
from starjax.core.types import Command, Pose
from starjax.data import load, store
from starjax.sim.rollouts import agent, trocars

SEED, EXECUTE, OBS_HORIZON = 4, 4, 2
TAKEN, TROCAR = 6, 2  # control step of the takeover; index of the configuration


def stays(params, stats, keys, observation, trocar):
    """A policy that holds its tip and closes the jaws."""
    pose = observation.pose
    p = jnp.repeat(pose.p[:, -1:], EXECUTE, 1)
    return Command(Pose(jnp.repeat(pose.R[:, -1:], EXECUTE, 1), p), -jnp.ones(p.shape[:-1]))


@pytest.fixture(scope="module")
def relieved(env):
    policy = agent.from_policy(stays, OBS_HORIZON, EXECUTE)
    return recorder.steer(
        env, recorder.Relieved(policy, (None, None), "digest", OBS_HORIZON, EXECUTE)
    )


def played(steered, kept, limit=200):
    """The policy stays until the hand goes straight to the mark; not saved yet."""
    state, frame, action, opening = steered.start(SEED, TROCAR, kept.next_trial(TROCAR))
    goal = np.asarray(state.env.layout.p[0])
    while not frame.done and kept.length < limit:
        acts = kept.length >= TAKEN
        if acts:
            way = goal - action[0, 1:]
            action = action.copy()
            action[0, 1:] += way * min(1.0, 0.003 / max(np.linalg.norm(way), 1e-9))
        state, moment = steered.step(state, action, opening, acts)
        action, frame = moment.action, moment.frame
        kept.add(moment)
    return frame


@pytest.fixture(scope="module")
def root(relieved, tmp_path_factory):
    root = tmp_path_factory.mktemp("relief") / "interventions"
    with recorder.record_into(root, relieved.env, SEED, relieved.policy) as kept:
        assert not kept.is_worth_saving
        frame = played(relieved, kept, TAKEN)
        assert not frame.done and not kept.is_worth_saving  # the policy alone
        kept.discard()
        assert played(relieved, kept).success and kept.is_worth_saving
        kept.save(TROCAR, 0)
    return root


@pytest.mark.slow
@pytest.mark.release
def test_the_hands_part_is_an_intervention(root, relieved):
    (record,) = (store.verify(root, key) for key in store.keys(root))
    assert record["source"] == "intervention" and record["policy"] == "digest"
    assert record["first"] == TAKEN - (OBS_HORIZON - 1) and record["success"]
    actor = load.actors(root)
    np.testing.assert_array_equal(actor, np.where(np.arange(len(actor)) < 1, 0, 2))
    data = load.load(root, residency="host", report=lambda line: None).dataset
    assert len(mixing.learned_frames(actor, "intervention")) == len(actor) - 1
    gripper = np.asarray(data.command.gripper)[:, 0]
    assert gripper[0] == -1.0 and (gripper[1:] == 1.0).all()  # the policy closes, the hand opens
    p = rcm.trocar_position(data.trocar.trocar, relieved.env.p_world_ref)
    assert np.max(rcm.rcm_error(data.command.pose, np.repeat(p, len(gripper), 0))) < 1e-6


@pytest.mark.slow
def test_fine_tuning_takes_it_only_where_it_belongs(root, relieved, tmp_path):
    env, task = relieved.env, relieved.env.task

    def find(count=8, **changed):
        settings = FinetuneConfig(**{"interventions": str(root), **changed})
        return interventions.find(settings, env, trocars.select(task.trocars, slice(count)))

    assert find() == root
    with mistakes.of("--interventions", "--by rl"):
        find(by="rl")
    with mistakes.of("--interventions", f"0002-0000-{SEED}"):
        find(count=2)
    with mistakes.of("--interventions"):
        find(interventions=str(tmp_path))
    other = stubs.make_env()._replace(task=task._replace(name="other"))
    with mistakes.of("--interventions", task.name):
        interventions.find(FinetuneConfig(interventions=str(root)), other, task.trocars)
