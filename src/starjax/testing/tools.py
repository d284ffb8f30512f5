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
APART = 1e-3  # m between sizes of the record and of the file
ROUND = (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER)
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
    if not missing:
        yield verdict("shaft", _shaft(tool, m), "a cylinder of the record's radius and end")
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


def _shaft(tool: Tool, m: mujoco.MjModel) -> Iterator[str]:
    """Yields a fault if round geoms along z have other sizes than the record, or pads end apart."""
    data = mujoco.MjData(m)
    mujoco.mj_forward(m, data)
    base, tip = data.site(tool.base), data.site(tool.tcp)
    found = []
    for i in np.flatnonzero(np.isin(m.geom_type, ROUND)):
        z = base.xmat.reshape(3, 3)[:, 2]
        if abs(z @ data.geom_xmat[i].reshape(3, 3)[:, 2]) > 1.0 - NEAR_TURN:
            end = (base.xpos - data.geom_xpos[i]) @ z - m.geom_size[i, 1]
            found.append((float(m.geom_size[i, 0]), float(end)))
    expected = tool.shaft_radius, tool.shaft_end
    if found and np.abs(np.array(found) - expected).max(-1).min() > APART:
        texts = [f"{1e3 * radius:.1f} and {1e3 * end:.1f} mm" for radius, end in found]
        yield f"shaft_radius and shaft_end differ from the geoms' {', '.join(texts)}"
    z = tip.xmat.reshape(3, 3)[:, 2]
    for pad in tool.pads:
        centre, half = np.split(m.geom_aabb[m.geom(pad).id], 2)
        R = data.geom(pad).xmat.reshape(3, 3)
        end = float((data.geom(pad).xpos + R @ centre - tip.xpos) @ z + np.abs(z @ R) @ half)
        if abs(end - tool.pad_end) > APART:
            yield f"pad_end: {pad} ends {1e3 * end:.1f} mm past the tip"


def _pads(tool: Tool, m: mujoco.MjModel) -> Iterator[str]:
    if tool.jaw is not None and len(set(tool.pads)) < 2:
        yield f"jaws grasp with two pads, got {', '.join(tool.pads) or 'none'}"
    for pad in tool.pads:
        fault, ids = attempt("", lambda pad=pad: mjcf_parts.ids("MJCF", m, "geom", [pad]))
        if not fault and not m.geom_conaffinity[ids[0]] & OBJECT_BITS:
            yield f"{pad} has conaffinity {m.geom_conaffinity[ids[0]]}: it touches no object"
