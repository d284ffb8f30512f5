"""Checks of a tool: names of its record in its file, jaws, pads, direction of its tip."""

from collections.abc import Iterator

import jax.numpy as jnp
import mujoco
import numpy as np

from starjax import rcm
from starjax.sim import mjcf_parts, registries
from starjax.sim.tools.base import Tool
from starjax.testing.base import Check, attempt, not_finite, outside, verdict

BEND = (0.5, -0.4)  # rad, pitch and yaw of a bent wrist
NEAR, NEAR_TURN = 1e-5, 1e-4  # m, and of a rotation's entries
RANGES = {
    "closed": (-2.0, 2.0),
    "open": (-2.0, 2.0),
    "shaft_radius": (1e-4, 0.02),
    "shaft_end": (-0.1, 0.1),
    "pad_end": (-0.05, 0.05),
    "shaft_reach": (1e-3, 1.0),
    "palm_radius": (0.0, 0.05),
}  # m, or rad of jaws that turn
OBJECT_BITS = 4  # contype of objects that can be grasped, see mjcf/README.md


def check(name: str, n: int) -> Iterator[Check]:
    """Yields the checks of a tool; `n` is not used."""
    fault, read = attempt("record", lambda: _compile(name))
    if fault:
        yield fault
        return
    tool, m = read
    missing = [*_names(tool, m), *not_finite(tool), *outside(tool, RANGES)]
    yield verdict("record", missing, f"{m.ngeom} geoms, site {tool.tcp}")
    fault, _ = attempt("names", lambda: mjcf_parts.ids(f"tool {name}", m, "site", [tool.tcp]))
    if not fault:
        yield verdict("tip frame", _axis(tool, m), "z points away from the robot")
        if tool.wrist is not None and not missing:
            yield verdict("wrist", _wrist(tool, m), "its lengths and turns are those of the record")
    yield verdict("jaws", _jaws(tool, m), "none" if tool.jaw is None else "closed < open")
    yield verdict("pads", _pads(tool, m), f"{len(tool.pads)} touch contype {OBJECT_BITS}")


def _compile(name: str) -> tuple[Tool, mujoco.MjModel]:
    tool = registries.tools.get(name)
    spec = mjcf_parts.read(f"tool {name}", tool.mjcf)
    with mjcf_parts.explained(f"tool {name}"):
        return tool, spec.compile()


def _names(tool: Tool, m: mujoco.MjModel) -> Iterator[str]:
    named = {"site": [tool.tcp], "geom": [*tool.pads], "joint": [tool.jaw] if tool.jaw else []}
    named["actuator"] = [tool.servo] if tool.servo else []
    if tool.wrist is not None:
        named["site"].append(tool.shaft)
        named["joint"] += tool.wrist_joints
        named["actuator"] += tool.wrist_joints
    for kind, names in named.items():
        for name in names:
            fault, _ = attempt("", lambda k=kind, n=name: mjcf_parts.ids("MJCF", m, k, [n]))
            if fault:
                yield f"no {kind} {name}"


def _wrist(tool: Tool, m: mujoco.MjModel) -> Iterator[str]:
    """Yields a fault if the bent tool's tip is not where `rcm.tip_of` has it."""
    assert tool.wrist is not None
    data = mujoco.MjData(m)
    for joint, angle in zip(tool.wrist_joints, BEND, strict=True):
        data.joint(joint).qpos = angle
    mujoco.mj_forward(m, data)
    shaft, tip = (data.site(name) for name in (tool.shaft, tool.tcp))
    R = shaft.xmat.reshape(3, 3)
    there = rcm.tip_of(tool.wrist, rcm.Pose(jnp.eye(3), jnp.zeros(3)), np.array(BEND))
    away = np.linalg.norm(R.T @ (tip.xpos - shaft.xpos) - there.p)
    turned = np.abs(R.T @ tip.xmat.reshape(3, 3) - there.R).max()
    if away > NEAR or turned > NEAR_TURN:
        yield f"bent, the tip is {1e3 * away:.2g} mm and {turned:.2g} (rotation) off"


def _axis(tool: Tool, m: mujoco.MjModel) -> Iterator[str]:
    """Yields a fault if the tool's geoms are not behind its tip."""
    data = mujoco.MjData(m)
    mujoco.mj_forward(m, data)
    site = data.site(tool.tcp)
    along = (data.geom_xpos - site.xpos) @ site.xmat.reshape(3, 3)[:, 2]
    if m.ngeom and np.mean(along) > 0:
        yield f"the site's z axis points from {tool.tcp} into the tool"


def _jaws(tool: Tool, m: mujoco.MjModel) -> Iterator[str]:
    if tool.jaw is None:
        return
    if not tool.closed < tool.open:
        yield f"closed {tool.closed} is not below open {tool.open}"
    if tool.servo is None:
        yield "a jaw without a servo"
    fault, ids = attempt("", lambda: mjcf_parts.ids("MJCF", m, "joint", [str(tool.jaw)]))
    if not fault and m.jnt_limited[ids[0]] and tool.open > m.jnt_range[ids[0], 1]:
        yield f"open {tool.open} is beyond the joint's range {m.jnt_range[ids[0]].tolist()}"


def _pads(tool: Tool, m: mujoco.MjModel) -> Iterator[str]:
    for pad in tool.pads:
        fault, ids = attempt("", lambda pad=pad: mjcf_parts.ids("MJCF", m, "geom", [pad]))
        if not fault and not m.geom_conaffinity[ids[0]] & OBJECT_BITS:
            yield f"{pad} has conaffinity {m.geom_conaffinity[ids[0]]}: it touches no object"
