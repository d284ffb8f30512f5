"""Pairs of trocars: as far apart as surgeons place them, wherever they are drawn."""

import itertools
import types

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from starjax import rcm
from starjax.core.types import Pose
from starjax.envs import trocar_draws
from starjax.evaluation import sweep
from starjax.sim import registries, scene
from starjax.tasks import handover as handovers
from starjax.tasks import two_arms
from starjax.tasks.needle_handover import expert as handover
from starjax.tasks.peg_transfer_bimanual import expert as bimanual

DRAWN = 10_000
COLLISION = 0.0005  # m, overlap that is called one
REGION = 0.055  # m, across: each trocar varies within 3 to 5 cm


def ports(pairs):
    places = np.array([slot.p_world_ref for slot in two_arms.SLOTS], np.float32)
    return np.asarray(rcm.trocar_position(pairs, places), np.float64)


def corners():
    """Every corner of both workspaces, `[4096, 2]`; the middle of their ranges too."""
    ends = []
    for slot in two_arms.SLOTS:
        work = registries.workspaces.get(slot.workspace)
        ranges = [np.linspace(*r, 4) for r in (work.radius, work.polar, work.azimuth)]
        ends.append(np.array(list(itertools.product(*ranges)), np.float32))
    left, right = (x.reshape(-1, 3) for x in np.broadcast_arrays(ends[0][:, None], ends[1]))
    return rcm.Trocar(*np.stack([left, right], axis=1).transpose(2, 0, 1))


PAIRS = {
    "twelve": lambda: two_arms.TROCARS,
    "corners": corners,
    "swept": lambda: sweep.sample(0, DRAWN, registries.tasks.get("peg_transfer_bimanual")),
    "played": lambda: jax.vmap(
        trocar_draws.make(registries.tasks.get("needle_handover"), "random")
    )(jax.random.split(jax.random.key(1), DRAWN)),
}


@pytest.mark.parametrize("source", PAIRS)
def test_a_pair_is_100_to_170_mm_and_37_to_60_degrees_apart(source):
    p = ports(PAIRS[source]())
    apart = np.linalg.norm(p[:, 0] - p[:, 1], axis=-1)
    shafts = p / np.linalg.norm(p, axis=-1, keepdims=True)  # to the middle of the board
    angle = np.rad2deg(np.arccos((shafts[:, 0] * shafts[:, 1]).sum(-1)))
    assert apart.min() >= 0.1 and apart.max() <= 0.17
    assert angle.min() >= 37 and angle.max() <= 60
    for arm in range(2):
        assert np.ptp(p[:, arm], axis=0).max() < REGION
    if source != "twelve":
        assert (np.ptp(p, axis=0)[:, :2] > 0.028).all()


def test_six_blocks_stand_side_by_side_at_any_yaw():
    m = scene.compose(scene.name("peg_transfer_bimanual"))
    pegs = registries.tasks.get("peg_transfer_bimanual").bind(m).pegs
    apart = np.linalg.norm(pegs[:, None] - pegs, axis=-1)[~np.eye(len(pegs), dtype=bool)]
    parts = [g for g in range(m.ngeom) if m.geom(g).name.startswith(("wall", "corner", "leg"))]
    ends = [  # capsules: their axes, and how thick they are
        np.linalg.norm((m.geom_pos[g] + s * m.geom_size[g, 1] * axis(m.geom_quat[g]))[:2])
        + m.geom_size[g, 0]
        for g in parts
        for s in (-1, 1)
    ]
    assert apart.min() > 2 * max(ends) - COLLISION


YAWS = np.linspace(-0.5, 0.5, 7)  # rad, of the handed object
# What each expert's tools hold: segments of the wire; the wall's normal and its direction.
HELD = {
    handover: jnp.array([2, 4]),
    bimanual: (jnp.array([0.0, 1.0, 0.0]), jnp.array([1.0, 0.0, 0.0])),
}


@pytest.mark.parametrize("expert", HELD, ids=lambda expert: expert.__name__.split(".")[-2])
def test_a_tool_first_turns_on_a_way_that_says_how(expert):
    """A roll network sees the coming path of its arm, not the object."""
    tips = jnp.array(handover.PARK)
    script = types.SimpleNamespace(p=tips, held=HELD[expert])

    def goals(yaw):
        there = Pose(rcm.rotation_z(yaw), jnp.array([0.003, 0.002, 0.01]))
        state = types.SimpleNamespace(
            measurements=types.SimpleNamespace(needle=there, block=there),
            layout=types.SimpleNamespace(target_peg=jnp.zeros(2), needle=there),
            pose=Pose(jnp.stack([jnp.eye(3)] * 2), tips),
        )
        return expert.PLAY.goals(script, state)

    found, normals = jax.vmap(goals)(jnp.array(YAWS))
    normals = jnp.broadcast_to(normals.reshape(len(YAWS), -1, 3), (len(YAWS), 2, 3))
    for arm, come in enumerate((jnp.zeros(3), jnp.array(expert.COME))):
        turns = int(np.argmax(expert.PLAY.looks[:, arm]))
        way = (found[:, turns - 1, arm] - found[:, turns, arm] - come)[:, :2]
        along = jnp.sum(way * normals[:, arm, :2], axis=-1)
        np.testing.assert_allclose(jnp.abs(along), handovers.OUT, rtol=1e-4)
        np.testing.assert_allclose(jnp.linalg.norm(way, axis=-1), handovers.OUT, rtol=1e-4)
        assert expert.PLAY.turned[turns] < 1.0


def axis(quat):
    R = np.zeros(9)
    mujoco.mju_quat2Mat(R, quat)
    return R.reshape(3, 3)[:, 2]


def test_unseen_pairs_are_at_the_edge_and_in_the_middle():
    task = registries.tasks.get("peg_transfer_bimanual")
    p = ports(task.trocars)
    apart = np.linalg.norm(p[:, 0] - p[:, 1], axis=-1)
    assert set(np.argsort(apart)[[0, -1]]) <= set(np.flatnonzero(~task.is_seen))
    assert task.trocars is registries.tasks.get("needle_handover").trocars
