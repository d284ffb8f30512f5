"""Kinematics of an arm with its instrument: of a dVRK's in closed form, of others by its chain."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from starjax import rcm
from starjax.addons.robots import crtk, psm
from starjax.core.errors import UsageError
from starjax.core.types import Pose

PSM = "psm"
INSTRUMENTS = {"large_needle_driver": psm.LARGE_NEEDLE_DRIVER, "prograsp": psm.PROGRASP}
# The tools of the simulation that these instruments are.
TOOLS = {"large_needle_driver": "needle_driver", "prograsp": "prograsp"}
MAX_RESIDUAL = 5e-4  # m, of inverse kinematics: beyond it a pose is out of reach
# rad and m: closer to a limit no command may go. A wrist may work at its limits.
_MARGIN = 0.05
_PSM_MARGINS = np.array([_MARGIN, _MARGIN, 0.005, _MARGIN, 0.0, 0.0])
_ITERATIONS = 8  # from the joints of the last command


class Kinematics(NamedTuple):
    """Kinematics of J joints, one configuration at a time.

    Attributes:
      names: sets of names that `measured_js` may have, each in the order of the joints.
      limits: `[J, 2]` rad or m.
      home: `[J]`.
      wrist: of the instrument, None of a straight one.
      pose_world_base: of the simulation's mount, None of a dVRK's arm, whose base is its trocar.
      tip_of, shaft_of: `[J]` -> pose in the base frame.
      joints_of: (pose_base_tip, `[J]` near) -> `[J]` within the limits, or UsageError. One that
        is near a limit may only leave it.
    """

    names: Sequence[Sequence[str]]
    limits: np.ndarray
    home: np.ndarray
    wrist: rcm.Wrist | None
    pose_world_base: Pose | None
    tip_of: Callable[[np.ndarray], Pose]
    shaft_of: Callable[[np.ndarray], Pose]
    joints_of: Callable[[Pose, np.ndarray], np.ndarray]


def kinds() -> list[str]:
    """Returns the kinds of arms: a dVRK's, and those of the registry that take joints."""
    from starjax.sim import registries

    arms = registries.arms
    return [PSM, *(name for name in arms.names() if not arms.get(name).remote_centre)]


def of(kind: str, instrument: str, task: str) -> Kinematics:
    """Returns the kinematics of an arm.

    Args:
      kind: `psm`, or an arm of the registry.
      instrument: key of `INSTRUMENTS`, or a straight tool of the registry.
      task: whose mount of an arm of the registry has the tool's turn on the flange.

    Raises:
      UsageError: there is no such mount.
    """
    if kind == PSM:
        return of_psm(INSTRUMENTS[instrument])
    return of_chain(kind, instrument, task)


def of_psm(instrument: psm.Instrument) -> Kinematics:
    """Returns the closed kinematics of a patient side manipulator."""

    def joints_of(pose_base_tip: Pose, near: np.ndarray) -> np.ndarray:
        q = psm.joints_of(pose_base_tip, instrument)
        q = min((q, psm.half_turn(q)), key=lambda x: np.abs(x - near).max())
        return _within(q, near, psm.LIMITS, _PSM_MARGINS, psm.JOINTS)

    return Kinematics(
        psm.NAMES,
        psm.LIMITS,
        np.array([0.1, 0.05, 0.13, 0.3, 0.0, 0.0]),
        instrument.wrist,
        None,
        lambda q: psm.tip_of(q, instrument),
        lambda q: psm.shaft_of(q, instrument),
        joints_of,
    )


def of_chain(kind: str, tool: str, task: str) -> Kinematics:
    """Returns the kinematics of an arm of the registry with a straight tool, float32."""
    import jax

    from starjax.sim import ik, registries
    from starjax.sim import scene as scenes

    if registries.tools.get(tool).wrist is not None:
        raise UsageError("arm.instrument", f"a straight tool on {kind}", tool)
    bound = scenes.load(scenes.name(task, (kind,), (tool,))).arms[0]
    mount = crtk.pose_of_arrays(bound.chain.R_base, bound.chain.p_base)
    chain = bound.chain.replace(p_base=np.zeros(3, np.float32), R_base=np.eye(3, dtype=np.float32))
    home = jax.numpy.asarray(bound.home)
    forward = jax.jit(lambda q: ik.forward(chain, q)[0])

    @jax.jit
    def solve(pose: Pose, q: jax.Array) -> tuple[jax.Array, jax.Array]:
        return ik.solve(chain, pose, q, _ITERATIONS, home, bound.arm.rest_gain)

    def tip_of(q: np.ndarray) -> Pose:
        R, p = jax.device_get(forward(np.asarray(q, np.float32)))
        return crtk.pose_of_arrays(np.asarray(R, np.float64), np.asarray(p, np.float64))

    def joints_of(pose_base_tip: Pose, near: np.ndarray) -> np.ndarray:
        pose = crtk.pose_of_arrays(*(np.asarray(x, np.float32) for x in pose_base_tip))
        q, residual = jax.device_get(solve(pose, np.asarray(near, np.float32)))
        if not residual < MAX_RESIDUAL:
            raise UsageError("pose_base_tip", "a pose within reach", f"{1e3 * residual:.1f} mm off")
        limits, margins = bound.chain.limits, np.full(len(q), _MARGIN)
        return _within(np.asarray(q, np.float64), near, limits, margins, bound.arm.joints)

    return Kinematics(
        (bound.arm.joints,), bound.chain.limits, bound.home, None, mount, tip_of, tip_of, joints_of
    )


def _within(
    q: np.ndarray,
    near: np.ndarray,
    limits: np.ndarray,
    margins: np.ndarray,
    names: Sequence[str],
) -> np.ndarray:
    left, before = (np.minimum(x - limits[:, 0], limits[:, 1] - x) for x in (q, near))
    bad = np.flatnonzero(~(left >= 0.0) | ((left < margins) & (left < before)))
    if bad.size:
        j = int(bad[0])
        low, high = limits[j]
        expected = f"{low:.3g} to {high:.3g}, its limits, less {margins[j]:g}"
        raise UsageError(names[j], expected, f"{q[j]:.3g}")
    return q
