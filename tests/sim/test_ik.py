"""Kinematics of chains: C MuJoCo is the oracle, random arms are the cases."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from starjax.core import errors
from starjax.core.types import Pose
from starjax.sim import assets, ik
from starjax.sim.chain import chain_of

FR5_HOME = (-0.18, -1.10, 1.90, -2.36, -1.571, 0.0)
WEIGHT = 0.3


@pytest.fixture(scope="module")
def fr5():
    arm = mujoco.MjSpec.from_file(str(assets.path("arms/fr5/fr5.xml")))
    tool = mujoco.MjSpec.from_file(str(assets.path("tools/grasper/grasper.xml")))
    arm.attach(tool, site=arm.site("flange"), prefix="tool/")
    return chain_of(arm.compile(), "shoulder", "tool/tcp")


def numbers(values):
    return " ".join(f"{v:.6f}" for v in values)


def random_arm(rng, bodies):
    """An MJCF with any axes, anchors, references, slides, bodies of no joint and of two."""
    xml, names = "", []
    for b in range(bodies):
        place = f'pos="{numbers(rng.normal(0, 0.2, 3))}" quat="{numbers(rng.normal(size=4))}"'
        xml += f'<body name="b{b}" {place}><geom size="0.01"/>'
        for _ in range(1 if b == 0 else rng.choice(3, p=[0.2, 0.6, 0.2])):
            kind, name = ("slide" if rng.random() < 0.3 else "hinge"), f"j{len(names)}"
            axis, at = numbers(rng.normal(size=3)), numbers(rng.normal(0, 0.1, 3))
            where = f'axis="{axis}" pos="{at}" ref="{rng.normal():.3f}"'
            xml += f'<joint name="{name}" type="{kind}" {where}/>'
            names.append(name)
    tip, stand = (
        f'pos="{numbers(rng.normal(0, 0.1, 3))}" quat="{numbers(rng.normal(size=4))}"'
        for _ in range(2)
    )
    site = f'<site name="tip" {tip}/>'
    whole = f'<body name="stand" {stand}>{xml}{site}{"</body>" * bodies}</body>'
    text = f'<mujoco><compiler angle="radian"/><worldbody>{whole}</worldbody></mujoco>'
    return mujoco.MjModel.from_xml_string(text), tuple(names)


@pytest.mark.parametrize("seed", range(12))
def test_any_chain_of_hinges_and_slides_moves_as_in_mujoco(seed):
    rng = np.random.default_rng(seed)
    m, names = random_arm(rng, bodies=1 + seed % 7)
    chain = chain_of(m, "b0", "tip", names)
    data = mujoco.MjData(m)
    data.qpos[:] = rng.normal(0, 1.0, m.nq)
    mujoco.mj_kinematics(m, data)
    mujoco.mj_comPos(m, data)
    q = jnp.asarray(data.qpos, jnp.float32)
    pose, origins, axes = ik.forward(chain, q)
    site = data.site("tip")
    np.testing.assert_allclose(pose.p, site.xpos, atol=1e-5)
    np.testing.assert_allclose(pose.R, site.xmat.reshape(3, 3), atol=1e-5)
    np.testing.assert_allclose(axes, data.xaxis, atol=1e-5)
    hinges = ~np.array(chain.slides)
    np.testing.assert_allclose(origins[hinges], data.xanchor[hinges], atol=1e-5)
    moves, turns = np.zeros((2, 3, m.nv))
    mujoco.mj_jacSite(m, data, moves, turns, m.site("tip").id)
    expected = np.concatenate([moves, WEIGHT * turns])
    np.testing.assert_allclose(ik.jacobian(chain, q, WEIGHT), expected, atol=2e-5)


def test_a_chain_stands_where_its_caller_says(fr5):
    q = jnp.asarray(FR5_HOME)
    there = jnp.array([0.1, -0.2, 0.3])
    at_origin, _, _ = ik.forward(fr5, q)
    moved = jax.jit(lambda p_base: ik.forward(fr5.replace(p_base=p_base), q)[0])(there)
    np.testing.assert_allclose(moved.p, at_origin.p + there, atol=1e-6)
    np.testing.assert_allclose(moved.R, at_origin.R, atol=1e-6)


def two_bodies(joint, second):
    """Body a with `joint`, in it body b with `second` and the site tip."""
    inside = f'<body name="b">{second}<geom size="1"/><site name="tip"/></body>'
    body = f'<body name="a">{joint}<geom size="1"/>{inside}</body>'
    return f"<mujoco><worldbody>{body}</worldbody></mujoco>"


HINGE = '<joint name="x"/>'
TWO = two_bodies(HINGE, '<joint name="y"/>')
BALL = two_bodies(HINGE, '<joint name="y" type="ball"/>')
FREE = two_bodies('<freejoint name="x"/>', "")


@pytest.mark.parametrize(
    ("xml", "first", "joints", "argument", "got"),
    [
        (BALL, "a", (), "joint y", "a ball"),
        (FREE, "a", (), "joint x", "a free joint"),
        (TWO, "c", (), "first", "'c'"),
        (TWO, "b", (), "first", "'b'"),
        (TWO, "a", ("y", "x"), "joints", "y x"),
        (FREE, "b", (), "first", "'b'"),
    ],
)
def test_what_cannot_be_read_is_refused(xml, first, joints, argument, got):
    with pytest.raises(errors.UsageError) as raised:
        chain_of(mujoco.MjModel.from_xml_string(xml), first, "tip", joints)
    assert (raised.value.argument, raised.value.got) == (argument, got)


@pytest.mark.parametrize("turn", [[-1, -1, 1], [1, -1, -1], [-1, 1, -1]])
def test_half_a_turn_is_as_far_as_it_is(fr5, turn):
    q = jnp.asarray(FR5_HOME)
    pose, _, _ = ik.forward(fr5, q)
    target = Pose(pose.R @ np.diag(np.float32(turn)), pose.p)
    far = np.pi * ik.ROTATION_WEIGHT
    np.testing.assert_allclose(ik.residual(fr5, target, q), far, rtol=1e-4)
    if turn[2] == 1:  # the jaws exchanged, which only the limit of the last joint prevents
        _, residual = ik.solve(fr5, target, q, 40)
        assert residual < 0.05 * far


def test_joints_stay_within_their_limits(fr5):
    out_of_reach = Pose(jnp.eye(3), jnp.array([0.0, 0.0, 2.0]))
    q, residual = ik.solve(fr5, out_of_reach, jnp.asarray(FR5_HOME), 40)
    low, high = fr5.limits.T
    assert residual > 0.1 and (q > low).all() and (q < high).all()


@pytest.mark.parametrize("bodies", [3, 6])
def test_a_near_pose_is_found_with_few_joints_and_with_many(bodies):
    rng = np.random.default_rng(bodies)
    chain = chain_of(random_arm(rng, bodies)[0], "b0", "tip")
    q, step = rng.normal(size=(2, len(chain.slides))).astype(np.float32)
    target, _, _ = ik.forward(chain, jnp.asarray(q + 0.05 * step))
    _, residual = ik.solve(chain, target, jnp.asarray(q), 20)
    assert residual < 2e-5


def test_free_joints_return_to_where_they_are_at_home():
    """Five laps of a closed path: without the null-space term the redundant joints drift."""
    m = mujoco.MjModel.from_xml_string(SEVEN)
    chain = chain_of(m, "l0", "tip")
    home = jnp.array([0.1, 0.6, -0.1, 1.2, 0.1, 0.8, 0.0])
    start, _, _ = ik.forward(chain, home)
    lap = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    circle = 0.08 * np.stack([np.cos(lap) - 1, np.sin(lap), 0.5 * np.sin(2 * lap)], axis=-1)
    path = start.p + jnp.asarray(np.tile(circle, (5, 1)), jnp.float32)

    def drift(gain):
        def one(q, p):
            q, residual = ik.solve(chain, Pose(start.R, p), q, 4, home, gain)
            return q, (q, residual)

        _, (q, residual) = jax.jit(lambda: jax.lax.scan(one, home, path))()
        assert residual.max() < 1e-5
        ends = q[59::60]
        return float(jnp.abs(ends - ends[1]).max())

    assert drift(0.1) < 1e-6 < 1e-3 < drift(0.0)


# Seven hinges, the axes of which are alternately along and across the links, as in an arm.
SEVEN = (
    '<mujoco><compiler angle="radian"/><worldbody>'
    + "".join(
        f'<body name="l{i}" pos="0 0 0.2"><joint axis="{axis}"/><geom size="0.02"/>'
        for i, axis in enumerate(["0 0 1", "0 1 0"] * 3 + ["0 0 1"])
    )
    + '<site name="tip" pos="0.05 0 0.2"/>'
    + "</body>" * 7
    + "</worldbody></mujoco>"
)
