"""The start of a plan: refused far from the tool, approached from a shallow one."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax import deploy, rcm
from starjax.core.errors import UsageError
from starjax.data import normalizer
from starjax.deploy import approach

RNG = np.random.default_rng(0)
P_WORLD_TROCAR = np.array([0.014, 0.014, 0.153], np.float32)


@pytest.fixture(scope="module")
def compact():
    return deploy.load("compact", ddim_steps=2)


@pytest.fixture(scope="module")
def unled():
    """The same, whose plans are its own, however far they begin."""
    policy = deploy.load("compact", ddim_steps=2, max_first_move=np.inf, max_first_turn=np.inf)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(
            approach, "with_approach", lambda action_space, stats, now, plan, told: plan
        )
        pose, trocar = tool(policy, [0.0, 0.0, 0.03])
        policy(jax.random.key(0), seen(pose), trocar)  # compiles it so
    return policy


def seen(pose, moments=2):
    """A robot that stands still in the dark."""
    return deploy.Observation(
        pose=jax.tree.map(lambda x: np.stack([x] * moments), pose),
        gripper=np.ones(moments, np.float32),
        image=np.zeros((moments, 128, 128, 3), np.uint8),
    )


def tool(policy, p_world_tip, roll=0.0):
    trocar = rcm.trocar_from_position(P_WORLD_TROCAR, policy.p_world_ref)
    action = np.array([roll, *p_world_tip], np.float32)
    pose, _ = rcm.ACTION_SPACES["rcm4"].decode(action, trocar, policy.p_world_ref)
    return jax.tree.map(np.asarray, pose), trocar


def refused(policy, pose, trocar):
    with pytest.raises(UsageError) as caught:
        policy(jax.random.key(0), seen(pose), trocar)
    return caught.value


def turns(R, other):
    """Angles in rad between rotations, in float64."""
    Q = np.swapaxes(np.asarray(R, np.float64), -1, -2) @ np.asarray(other, np.float64)
    sin = np.linalg.norm(Q - np.swapaxes(Q, -1, -2), axis=(-2, -1)) / np.sqrt(8.0)
    return np.arctan2(sin, (np.trace(Q, axis1=-2, axis2=-1) - 1.0) / 2.0)


def test_a_tool_that_points_out_of_the_body_is_refused(compact):
    """As a quaternion w x y z read as x y z w gives it."""
    pose, trocar = tool(compact, [0.0, 0.0, 0.03])
    turned = pose._replace(R=pose.R @ np.diag([1.0, -1.0, -1.0]).astype(np.float32))
    found = refused(compact, turned, trocar)
    assert found.argument == "observation.pose" and "beyond the trocar" in found.expected


def test_a_tip_before_the_trocar_is_refused(compact):
    pose, trocar = tool(compact, [0.0, 0.0, 0.03])
    outside = pose._replace(p=P_WORLD_TROCAR - 0.03 * pose.R[:, 2])
    found = refused(compact, outside, trocar)
    assert found.argument == "observation.pose" and "30 mm" in found.got


def test_a_plan_that_begins_near_the_tool_is_the_policys_own(compact, unled):
    pose, trocar = tool(compact, [0.0, 0.0, 0.03])
    plans = [policy(jax.random.key(0), seen(pose), trocar) for policy in (compact, unled)]
    jax.tree.map(np.testing.assert_array_equal, *plans)
    assert np.linalg.norm(plans[0].pose.p[0] - pose.p) < approach.MAX_FIRST_MOVE


@pytest.mark.parametrize(
    ("bound", "limits"),
    [
        ("max_first_move", {"max_first_move": 1e-5}),
        ("max_first_turn", {"max_first_turn": 1e-5}),
    ],
)
def test_a_plan_that_begins_beyond_the_owners_bound_is_refused(bound, limits):
    policy = deploy.load("compact", ddim_steps=2, **limits)
    pose, trocar = tool(policy, [0.0, 0.0, 0.03])
    assert refused(policy, pose, trocar).argument == bound


@pytest.mark.parametrize("bound", [0.0, -1.0, np.nan, "far", None])
def test_a_bound_is_more_than_nothing(bound):
    for name in ("max_first_move", "max_first_turn"):
        with pytest.raises(UsageError) as caught:
            deploy.load("compact", **{name: bound})
        assert caught.value.argument == name


@pytest.mark.parametrize("limits", [{}, {"max_first_move": np.inf, "max_first_turn": np.inf}])
@pytest.mark.parametrize("depth", [0.001, 0.02, 0.06])
def test_from_a_tip_just_within_the_trocar_commands_lead_there_gradually(
    compact, unled, depth, limits
):
    """A robot at its last command, until the plans are the policy's own."""
    policy = dataclasses.replace(compact, **limits)
    axis = np.array([0.1, -0.05, -1.0]) / np.linalg.norm([0.1, -0.05, -1.0])
    pose, trocar = tool(compact, P_WORLD_TROCAR + max(depth, rcm.MIN_DEPTH) * axis, 0.8)
    pose = pose._replace(p=np.float32(P_WORLD_TROCAR + depth * axis))
    for decision in range(100):
        key = jax.random.fold_in(jax.random.key(0), decision)
        plan = jax.device_get(policy(key, seen(pose), trocar))
        wanted = jax.device_get(unled(key, seen(pose), trocar))
        is_own = np.array_equal(plan.pose.p, wanted.pose.p)
        assert rcm.rcm_error(plan.pose, P_WORLD_TROCAR).max() < 1e-6
        if is_own:
            assert np.linalg.norm(plan.pose.p[0] - pose.p) <= approach.NEAR_MOVE
            break
        positions = np.concatenate([pose.p[None], plan.pose.p])
        moves = np.linalg.norm(np.diff(positions, axis=0), axis=-1)
        rotations = np.concatenate([pose.R[None], plan.pose.R])
        shallow = decision == 0 and depth < rcm.MIN_DEPTH  # no command is shallower
        assert moves.max() <= (rcm.MIN_DEPTH if shallow else approach.APPROACH_MOVE + 1e-6)
        assert turns(rotations[:-1], rotations[1:]).max() <= approach.APPROACH_TURN + 1e-4
        pose = jax.tree.map(lambda x: x[compact.settings.execute - 1], plan.pose)
    assert is_own and decision > 2


def test_within_a_program_it_leads_too(compact):
    pose, trocar = tool(compact, [0.014, 0.014, 0.1])
    wanted = compact(jax.random.key(0), seen(pose), trocar)
    got = jax.jit(compact)(jax.random.key(0), *jax.tree.map(jnp.asarray, (seen(pose), trocar)))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), got, wanted)
    assert np.linalg.norm(got.pose.p[0] - pose.p) <= approach.APPROACH_MOVE + 1e-6


def test_a_tip_aside_of_the_demonstrated_ones_is_not_led(compact):
    """It is as deep as they are: a frame is wrong, or something else is."""
    pose, trocar = tool(compact, [0.0, 0.09, 0.0])
    assert refused(compact, pose, trocar).argument == "max_first_move"


@pytest.mark.parametrize(("beyond", "outside"), [(1e-5, False), (0.05, True)])
def test_a_tip_at_the_edge_of_the_demonstrated_ones_is_known(beyond, outside):
    """Commands end there, so rounding must not decide."""
    stats = normalizer.Normalizer(normalizer.MinMax(-0.05 * np.ones(5), 0.05 * np.ones(5)), None)
    p_world_ref = np.float32([0.0, 0.0, 0.15])
    told = rcm.trocar_frame(rcm.trocar_from_position(P_WORLD_TROCAR, p_world_ref), p_world_ref)
    tip = np.float32([0.0, 0.0, 0.05 * (1.0 + beyond)])
    pose, _ = rcm.ACTION_SPACES["rcm4"].decode(
        np.append(np.float32(0.0), tip),
        rcm.trocar_from_position(P_WORLD_TROCAR, p_world_ref),
        p_world_ref,
    )
    now = jax.tree.map(lambda x: jnp.asarray(x)[None, None], pose)
    told = jax.tree.map(lambda x: jnp.asarray(x)[None, None], told)
    assert bool(approach._is_outside("rcm4", stats, now, told).all()) is outside


@pytest.mark.parametrize("angle", [0.0, 1e-6, 1.0, np.pi - 1e-3, np.pi])
def test_a_way_is_straight_and_ends_at_the_command(angle):
    axis = RNG.normal(size=3)
    axis /= np.linalg.norm(axis)
    K = np.cross(np.eye(3), axis)
    turn = np.eye(3) + np.sin(angle) * K.T + (1.0 - np.cos(angle)) * K.T @ K.T
    R = np.asarray(rcm.rot6d_decode(RNG.normal(size=(1, 1, 6))))
    p = np.zeros((1, 1, 3), np.float32)
    now, begin = (rcm.pose_at_depth(np.float32(x), d, p) for x, d in ((R, 0.01), (R @ turn, 0.1)))
    way = approach._approach(now, begin, p, 2000)
    assert np.abs(way.p[:, -1] - begin.p).max() < 1e-5
    if angle < np.pi:  # there two ways are as short
        assert turns(way.R[:, -1], begin.R).max() < 2e-3
    steps = np.diff(np.concatenate([now.p[:, None], way.p], axis=1), axis=1)
    assert np.linalg.norm(steps, axis=-1).max() <= approach.APPROACH_MOVE + 1e-6
    assert turns(way.R[:, :-1], way.R[:, 1:]).max() <= approach.APPROACH_TURN + 1e-4
    assert rcm.rcm_error(way, p[:, None]).max() < 1e-6
