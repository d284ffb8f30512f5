"""Bounds of samples: the range of each action space, fitted to demonstrations."""

import fakes
import jax
import numpy as np
import pytest

from starjax import rcm
from starjax.core.methods import METHODS
from starjax.data import normalizer

FRAMES = np.arange(240)
RELATIVE = ["rcm1", "rcm2", "rcm3"]


@pytest.fixture(scope="module")
def dataset():
    return fakes.dataset(seed=0)


def fitted(space, dataset):
    row = METHODS["dp_rcm1"]._replace(action_space=space)
    return normalizer.fit(row, fakes.TASK, dataset, FRAMES).action


@pytest.mark.parametrize("name", RELATIVE)
def test_a_demonstrated_tip_is_within_reach_through_every_port(dataset, name):
    space, box = rcm.ACTION_SPACES[name], fitted(name, dataset)
    drawn = rcm.sample_trocar(jax.random.key(3), (200,))
    ports = jax.tree.map(lambda *fields: np.concatenate(fields), rcm.TROCARS, drawn)

    def through(port):
        frame = rcm.trocar_frame(port, fakes.P_WORLD_REF)
        pose = rcm.project(dataset.command.pose, frame.p_world_trocar)
        return space.encode(pose, frame)

    actions = np.asarray(jax.jit(jax.vmap(through))(ports)).reshape(-1, space.dim)
    low, high = np.asarray(jax.vmap(box.denormalize)(box.reach))
    for part in (space.slices[kind] for kind in ("p", "depth") if kind in space.slices):
        beyond = np.maximum(low[part] - actions[:, part], actions[:, part] - high[part])
        assert (beyond.max(axis=0) <= 1e-3).all(), beyond.max(axis=0)
        # and no farther than the farthest port requires
        assert (high[part] - low[part] < 1.2 * np.ptp(actions[:, part], axis=0)).all()


@pytest.mark.parametrize("name", RELATIVE)
def test_rotations_roll_and_gripper_reach_as_far_as_they_were_shown(dataset, name):
    space, box = rcm.ACTION_SPACES[name], fitted(name, dataset)
    others = [space.slices[kind] for kind in ("R", "roll") if kind in space.slices]
    for part in [*others, slice(space.dim, None)]:
        np.testing.assert_array_equal(box.reach[0, part], -1.0)
        np.testing.assert_array_equal(box.reach[1, part], 1.0)


@pytest.mark.parametrize("name", ["se3", "rcm4"])
def test_a_position_in_the_world_reaches_as_far_as_it_was_shown(dataset, name):
    box, position = fitted(name, dataset), rcm.ACTION_SPACES[name].slices["p"]
    p = np.asarray(dataset.command.pose.p[:, 0])
    assert box.reach is None
    np.testing.assert_array_equal(np.asarray(box.low)[position], p.min(axis=0))
    np.testing.assert_array_equal(np.asarray(box.high)[position], p.max(axis=0))


def test_damaged_poses_are_told(dataset):
    pose = dataset.command.pose
    pose = pose._replace(p=pose.p.at[7].set(np.nan))
    command = dataset.command._replace(pose=pose)
    for name in ("rcm2", "rcm4"):
        with pytest.raises(ValueError, match="expected finite poses"):
            fitted(name, dataset.replace(command=command))
