"""Reach of an arm on its mount in a workspace.

A mount is as good as its worst pose: the least distance of a joint from its limits, and the least
singular value of the Jacobian, over all trocars, targets and rolls.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm
from starjax.core.types import Pose
from starjax.sim import ik, mjcf_parts, robot
from starjax.sim.arms.base import Arm, Mount
from starjax.sim.chain import chain_of
from starjax.sim.tools.base import Tool
from starjax.sim.workspaces import Workspace

# Angles (rad) of a wrist that targets have in turn: a mount must serve a bent tool as well.
BENDS = np.deg2rad([(0, 0), (30, 0), (0, 30), (-30, 0), (0, -30)])
# Requirements of a usable mount (a test checks every one).
MIN_MARGIN = 0.1  # rad to the nearest limit
MIN_SINGULAR = 0.03  # m, of [Jv; LEVER Jw]
REACHED = 1e-4  # m of residual
LEVER = 0.3  # m: a radian of turn, or of a joint, counts as many metres; the length of a tool
ITERATIONS = 40  # for inverse kinematics from home


class ArmSettings(NamedTuple):
    """Part of an arm's record that the compiled programs are made for, see `Arm`."""

    rest_gain: float
    remote_centre: bool
    watched: int
    link_radius: float


class Bench(NamedTuple):
    """An arm alone, its base at the world's origin.

    Attributes:
      flange, tip: chains to its flange and to the tool's tip, or to the shaft before a wrist, the
        tool not turned.
      wrist: of the tool, or None.
      settings: see there.
    """

    flange: ik.Chain
    tip: ik.Chain
    wrist: rcm.Wrist | None
    settings: ArmSettings


class Targets(NamedTuple):
    """Poses P of a workspace.

    Attributes:
      pose: pose_world_tip `[P]`, or of the shaft before a wrist, each on the RCM manifold of its
        trocar.
      p_world_trocar: `[P, 3]` m.
    """

    pose: Pose
    p_world_trocar: jax.Array


class Fit(NamedTuple):
    """Reach of poses, fields `[P]`, or the worst of all.

    Attributes:
      residual: m, of inverse kinematics.
      margin: rad to the nearest limit; `LEVER` m of a slide count as one.
      singular: m, least singular value of [Jv; LEVER Jw].
      height: m, of the lowest watched link above the table.
    """

    residual: np.ndarray
    margin: np.ndarray
    singular: np.ndarray
    height: np.ndarray


def bench(arm: Arm, tool: Tool) -> Bench:
    """Reads the arm with the tool off their MJCF.

    Raises:
      errors.UsageError: its part lacks something, see `robot.read`, or its joints cannot be read,
        see `chain_of`.
    """
    whole, held = robot.read(arm), mjcf_parts.read(f"tool {tool.name}", tool.mjcf)
    whole.attach(held, site=whole.site(robot.FLANGE), prefix="tool/")
    m = whole.compile()
    flange, tip = (
        chain_of(m, arm.first, site, arm.joints) for site in (robot.FLANGE, f"tool/{tool.base}")
    )
    settings = ArmSettings(arm.rest_gain, arm.remote_centre, arm.watched, arm.link_radius)
    return Bench(flange, tip, tool.wrist, settings)


def targets(workspace: Workspace, wrist: rcm.Wrist | None = None) -> Targets:
    """Returns a grid over the trocars, the tip's box and the rolls of a workspace.

    With azimuths all round it includes the paper's twelve trocars.
    """
    is_round = np.ptp(workspace.azimuth) > np.pi
    azimuth = np.linspace(*workspace.azimuth, 8 if is_round else 3, endpoint=not is_round)
    radius, polar = np.linspace(*workspace.radius, 3), np.linspace(*workspace.polar, 3)
    trocars = np.stack(np.meshgrid(radius, polar, azimuth), axis=-1).reshape(-1, 3)
    if is_round:
        trocars = np.concatenate([trocars, np.stack(rcm.TROCARS, axis=-1)])
    box = [np.linspace(*ends, 3) for ends in zip(workspace.low, workspace.high)]
    rolls = np.linspace(*workspace.rolls, 3)
    actions = np.stack(np.meshgrid(rolls, *box), axis=-1).reshape(-1, 4)
    pairs = np.repeat(trocars, len(actions), axis=0), np.tile(actions, (len(trocars), 1))
    fields, actions = (np.asarray(x, np.float32) for x in pairs)
    frame = frame_of(rcm.Trocar(*fields.T), workspace)
    return Targets(_carried(actions, frame, wrist), frame.p_world_trocar)


def middle(workspace: Workspace, wrist: rcm.Wrist | None = None) -> Targets:
    """Returns the pose in the middle of the workspace."""
    radius = 0.0 if np.ptp(workspace.azimuth) > np.pi else np.mean(workspace.radius)
    trocar = rcm.Trocar(radius, np.mean(workspace.polar), np.mean(workspace.azimuth))
    frame = frame_of(trocar, workspace)
    box = np.mean([workspace.low, workspace.high], axis=0)
    action = np.append(np.mean(workspace.rolls), box)
    return Targets(_carried(action, frame, wrist), frame.p_world_trocar)


def _carried(actions: np.ndarray, frame: rcm.TrocarFrame, wrist: rcm.Wrist | None) -> Pose:
    """Returns the poses `[P]` of rolls and tips `[P, 4]` that the arm carries, bent by `BENDS`."""
    if wrist is None:
        return rcm.ACTION_SPACES["rcm4"].decode(actions, frame)[0]
    rows = np.arange(actions.size // 4).reshape(actions.shape[:-1])
    angles = BENDS[rows % len(BENDS)].astype(np.float32)
    bent = np.concatenate([actions[..., :1], angles, actions[..., 1:]], axis=-1)
    tip, _ = rcm.rcm6(wrist).decode(bent, frame)
    return rcm.shaft_of(wrist, tip, angles)


def fit(at: Bench, mount: Mount, poses: Targets) -> Fit:
    """Measures the reach of each pose; a remote centre's position counts from the trocar."""
    place = jnp.array([*mount.position, mount.yaw, mount.turn, mount.tilt], jnp.float32)
    chain, home = standing(at.flange, at.tip, place), jnp.asarray(mount.home, jnp.float32)
    with jax.default_matmul_precision("highest"):
        residual, margin, height, J = _compiled(chain, home, poses, at.settings, ITERATIONS)
    singular = np.linalg.svd(np.asarray(J), compute_uv=False)[..., -1]
    height = np.asarray(height) - at.settings.link_radius
    return Fit(np.asarray(residual), np.asarray(margin), singular, height)


def worst(fits: Fit) -> Fit:
    """Returns the worst figure of each field."""
    return Fit(fits.residual.max(), fits.margin.min(), fits.singular.min(), fits.height.min())


def is_good(fits: Fit) -> bool:
    """Returns True if a mount with this fit is usable."""
    lowest = worst(fits)
    enough = lowest.margin >= MIN_MARGIN and lowest.singular >= MIN_SINGULAR
    return bool(enough and lowest.residual < REACHED and lowest.height > 0)


def standing(flange: ik.Chain, tip: ik.Chain, place: jax.Array) -> ik.Chain:
    """Returns an arm's chain on its mount, `place` `[6]`: position (m), yaw, turn, tilt (rad)."""
    yaw, turn, tilt = place[3:]
    R_stand = rcm.rotation_z(yaw) @ _rotation_y(tilt)
    R_flange = flange.R_tip @ rcm.rotation_z(turn)
    R_tool, p_tool = flange.R_tip.T @ tip.R_tip, flange.R_tip.T @ (tip.p_tip - flange.p_tip)
    return tip.replace(
        p_base=place[:3] + R_stand @ tip.p_base,
        R_base=R_stand @ tip.R_base,
        p_tip=flange.p_tip + R_flange @ p_tool,
        R_tip=R_flange @ R_tool,
    )


def _rotation_y(angle: jax.Array) -> jax.Array:
    c, s, zero, one = jnp.cos(angle), jnp.sin(angle), jnp.zeros(()), jnp.ones(())
    return jnp.stack([jnp.stack(row) for row in ((c, zero, s), (zero, one, zero), (-s, zero, c))])


def reach(
    chain: ik.Chain, home: jax.Array, poses: Targets, settings: ArmSettings, iterations: int
) -> tuple[jax.Array, ...]:
    """Returns residuals `[P]` m, margins `[P]` rad, lowest axes `[P]` m, Jacobians `[P, 6, J]`."""
    slides = np.array(chain.slides)

    def one(pose: Pose, p_world_trocar: jax.Array) -> tuple[jax.Array, ...]:
        there = chain
        if settings.remote_centre:
            there = chain.replace(p_base=chain.p_base + p_world_trocar)
        q, residual = ik.solve(there, pose, home, iterations, home, settings.rest_gain)
        room = jnp.minimum(q - chain.limits[:, 0], chain.limits[:, 1] - q)
        _, origins, _ = ik.forward(there, q)
        height = jnp.min(origins[settings.watched :, 2], initial=jnp.inf)
        J = ik.jacobian(there, q, LEVER)
        return residual, jnp.min(jnp.where(slides, room / LEVER, room)), height, J

    return jax.vmap(one)(*poses)


_compiled = jax.jit(reach, static_argnames=("settings", "iterations"))


def frame_of(trocar: rcm.Trocar, workspace: Workspace) -> rcm.TrocarFrame:
    return rcm.trocar_frame(trocar, np.array(workspace.p_world_ref), workspace.roll_zero)
