"""Rollouts of a round: takeovers, the stored part of an episode, and that it can be done again."""

import jax
import jax.numpy as jnp
import kill
import numpy as np
import pytest
import stubs

from starjax.addons.finetune import dagger, mixing, rounds
from starjax.core.types import Command
from starjax.data import load, redraw, store
from starjax.sim.rollouts import agent, takeover
from starjax.sim.rollouts.placement import DeviceLayout

TROCARS = stubs.trocars(0, 8)
LIMITS = takeover.TakeoverLimits(20, 9)
IDLE = 8  # commands of a policy that stays, starting from the next plan
SETTINGS = rounds.RoundSettings(0, 3, 6, 60, "", "digest", {"limits": LIMITS._asdict()})


def stay(params, stats, keys, observation, trocar):
    """A policy that does not move."""
    pose = jax.tree.map(lambda x: jnp.repeat(x[:, -1:], IDLE, 1), observation.pose)
    return Command(pose, -jnp.ones(pose.p.shape[:-1]))


POLICY = agent.from_policy(stay, 2, 4)


def way(observation="state"):
    return rounds.Way(
        source=takeover.INTERVENTION,
        agent=takeover.from_policy(POLICY, stubs.RESCUER),
        params=lambda clocks: ((None, None), takeover.TakeoverLimits(clocks, np.int32(9))),
        runs=(LIMITS.clock,),
        record=takeover.RECORDS[observation],
        choose=lambda found: dagger.chosen(found, 2),
        cause=lambda found: dagger.cause(found[0]),
    )


def collect(root, observation="state", **changed):
    env = stubs.make_env(observation, unlucky=0.2)
    settings = SETTINGS._replace(**changed)
    return rounds.collect(
        root,
        env,
        TROCARS,
        way(observation),
        settings,
        layout=DeviceLayout(lanes=4),
        report=lambda _: None,
    )


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    root = tmp_path_factory.mktemp("round") / "rollouts"
    return root, collect(root)


def test_what_the_expert_finished_is_kept_from_the_policys_last_look_on(done):
    root, outcomes = done
    records = [store.verify(root, key) for key in store.keys(root)]
    assert len(outcomes.trial) == 12 and 0 < outcomes.kept.sum() < 12
    np.testing.assert_array_equal(outcomes.kept, outcomes.success[:, 0])
    assert "stalled" in set(outcomes.cause) <= {"stalled", "invalid"}
    assert len(records) == outcomes.kept.sum()
    for record in records:
        assert record["source"] == "intervention" and record["cause"] == "stalled"
        assert record["step"] == 9 and record["policy"] == "digest" and record["success"]
        actor = np.load(root / "episodes" / record["key"] / "actor.npy")
        np.testing.assert_array_equal(actor, np.arange(record["length"]) > 0)


def test_no_window_has_a_command_of_the_policy(done):
    root, _ = done
    dataset = load.load(root, residency="host", report=lambda _: None).dataset
    frames = mixing.learned_frames(load.actors(root), takeover.INTERVENTION)
    assert len(frames) == len(dataset.episode) - len(dataset.start)
    batch = mixing.windows.gather(dataset, frames, 2, 5)
    assert (np.asarray(batch.command.gripper) == 1.0).all()  # the policy closes, the expert opens
    first = mixing.windows.gather(dataset, dataset.start + 1, 2, 5)
    before, now = np.moveaxis(np.asarray(first.observation.pose.p), 1, 0)
    np.testing.assert_array_equal(before, now)  # the policy stayed


def test_a_round_can_be_done_again(done, tmp_path):
    root, outcomes = done
    again = tmp_path / "rollouts"
    collect(again)
    assert kill.tree(again) == kill.tree(root)
    # After a kill within a chunk.
    (again / "chunk_0001.npz").unlink()
    (again / "SEALED.json").unlink()
    store.remove(again, store.keys(again)[-1])
    (again / "chunk_0002.npz").unlink()
    found = collect(again)
    assert kill.tree(again) == kill.tree(root)
    np.testing.assert_array_equal(found.success, outcomes.success)


def test_rounds_and_seeds_have_other_starts(done, tmp_path):
    found = [done[1], collect(tmp_path / "a", number=1), collect(tmp_path / "b", seed=4)]
    assert len({part.success.tobytes() for part in found}) == 3


def test_images_are_drawn_from_the_recorded_state(tmp_path):
    root = tmp_path / "rollouts"
    collect(root, "image", trials=2)
    env = stubs.make_env("image", unlucky=0.2)
    description = store.read_description(root)
    assert redraw.is_possible(description) and "image_camera" not in description["features"]
    loaded = load.load(root, residency="host", env=env, report=lambda _: None).dataset
    drawn = np.asarray(loaded.observation.images[stubs.CAMERA])[:, :, 0, 0]
    p = np.asarray(loaded.observation.pose.p)[:, 0]
    np.testing.assert_allclose(drawn[:, :3], p * 1000 + 128, atol=1.01)
    # The goal follows from the trial's key: the expert went there.
    last = loaded.start + loaded.length - 1
    goal = (drawn[last][:, 3:].astype(float) - 128) / 1000
    assert (
        np.linalg.norm(goal - np.asarray(loaded.command.pose.p)[last][:, 0], axis=-1) < 6e-3
    ).all()
