"""Checks of an arm: record and file, reach of its mounts, servos that hold it at home."""

from collections.abc import Iterator

import mujoco
import numpy as np

from starjax.sim import mounts, names, registries, robot
from starjax.sim import scene as scenes
from starjax.sim.arms.base import Arm
from starjax.testing.base import FAILED, NOTE, Check, attempt, not_finite, outside, verdict

RANGES = {"max_speed": (0.05, 50.0), "servo_frequency": (5.0, 2e3), "link_radius": (1e-3, 0.3)}
HOLD_S = 1.0
MAX_SAG = 1e-4  # m that the tip may move in `HOLD_S`
MIN_MARGIN = 0.05  # rad to the nearest limit; `find-mount` searches mounts with twice as much


def check(name: str, n: int) -> Iterator[Check]:
    """Yields the checks of an arm; `n` is not used."""
    fault, arm = attempt("record", lambda: registries.arms.get(name))
    if not fault:
        fault, _ = attempt("record", lambda: robot.read(arm))
    if fault:
        yield fault
        return
    text = f"{len(arm.joints)} joints with servos, flange"
    faults = [*not_finite(arm), *outside(arm, RANGES, "")]
    if arm.watched not in range(len(arm.joints)):
        faults.append(f"watched: expected the index of a joint, got {arm.watched}")
    record = verdict("record", faults, text)
    yield record
    if record.status == FAILED:
        return
    if not arm.mounts:
        hint = f"starjax find-mount {name} TOOL WORKSPACE searches one"
        yield Check("mounts", f"none in the record; {hint}", NOTE)
    for tool, workspace in arm.mounts:
        subject = f"mount of {tool} over the {workspace}"
        fault, reach = attempt(subject, lambda t=tool, w=workspace: _reach(arm, t, w))
        yield fault or reach
        if not fault:
            yield _hold(arm, tool, workspace)


def _reach(arm: Arm, tool: str, workspace: str) -> Check:
    """Returns the check of a mount's reach; a fault names the worst pose."""
    at = mounts.bench(arm, registries.tools.get(tool))
    poses = mounts.targets(registries.workspaces.get(workspace))
    fit = mounts.fit(at, arm.mounts[tool, workspace], poses)
    least = mounts.worst(fit)

    def where(index: np.intp) -> str:
        tip, trocar = (np.asarray(x[index]) for x in (poses.pose.p, poses.p_world_trocar))
        text = [", ".join(f"{1e3 * x:.0f}" for x in place) for place in (tip, trocar)]
        return f"with the tip at ({text[0]}) mm and the trocar at ({text[1]}) mm"

    faults = []
    if not least.residual < mounts.REACHED:
        faults.append(f"missed by {1e3 * least.residual:.2g} mm {where(fit.residual.argmax())}")
    if not least.margin >= MIN_MARGIN:
        faults.append(f"{least.margin:.3f} rad to a joint's limit {where(fit.margin.argmin())}")
    if not least.singular >= mounts.MIN_SINGULAR:
        faults.append(f"singular value {least.singular:.3f} m {where(fit.singular.argmin())}")
    if not least.height > 0:
        faults.append(f"a link {-least.height:.2f} m below the table {where(fit.height.argmin())}")
    text = f"{least.margin:.3f} rad to the limits, singular value {least.singular:.3f} m"
    return verdict(f"mount of {tool} over the {workspace}", faults, text)


def _hold(arm: Arm, tool: str, workspace: str) -> Check:
    """Returns the check that servos hold the arm at home in a task of the workspace."""
    subject = f"servos with {tool} over the {workspace}"
    task = _task_in(workspace)
    if not task:
        return Check(subject, f"no task has the workspace {workspace}", NOTE)
    record = registries.tasks.get(task)
    slots = [slot.workspace for slot in record.slots]
    a = slots.index(workspace)
    arms = tuple(arm.name if i == a else slot.arm for i, slot in enumerate(record.slots))
    tools = tuple(tool if i == a else slot.tool for i, slot in enumerate(record.slots))
    named = names.SceneNames(task, arms, tools, ())
    fault, m = attempt(subject, lambda: scenes.compose(named))
    if fault:
        return fault
    m.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT  # objects at home push the tool
    data = mujoco.MjData(m)
    for joint, value in zip(arm.joints, arm.mounts[tool, workspace].home):
        data.joint(f"arm{a}/{joint}").qpos = value
        data.actuator(f"arm{a}/{joint}").ctrl = value
    site = scenes.tcp(a, registries.tools.get(tool))
    mujoco.mj_forward(m, data)
    before = data.site(site).xpos.copy()
    mujoco.mj_step(m, data, round(HOLD_S / m.opt.timestep))
    moved = float(np.linalg.norm(data.site(site).xpos - before))
    sag = [] if moved < MAX_SAG else [f"the tip moves {1e3 * moved:.2g} mm in {HOLD_S:g} s at home"]
    return verdict(subject, sag, f"the tip moves {1e6 * moved:.1f} um in {HOLD_S:g} s at home")


def _task_in(workspace: str) -> str:
    """Returns a built-in task whose arm works in a workspace, or empty."""
    for name in registries.tasks.built_in:
        fault, task = attempt(name, lambda name=name: registries.tasks.get(name))
        if not fault and any(slot.workspace == workspace for slot in task.slots):
            return name
    return ""
