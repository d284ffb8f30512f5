"""Scenes: a task, its arms and tools composed into one MuJoCo model, with resolved ids.

Names of arm i begin with `arm<i>/` in the composed model, those of its tool with `arm<i>/tool/`.
`mjcf/README.md` lists the requirements of a part.
"""

import types
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import mujoco
import numpy as np

from starjax.core import errors
from starjax.core.config import DEFAULT_TASK
from starjax.sim import (
    contract,
    derived_views,
    endoscope_camera,
    ik,
    mjcf_parts,
    registries,
    robot,
    solver,
    wrists,
)
from starjax.sim.arms.base import Arm, Mount
from starjax.sim.camera import geometry
from starjax.sim.chain import chain_of
from starjax.sim.names import TISSUE, SceneNames
from starjax.sim.quiet_mjx import mjx
from starjax.sim.task import Task
from starjax.sim.tools.base import Tool

# Velocities from which MuJoCo and MJX choose sparse matrices; the contact solver has dense ones.
SPARSE_FROM = 60
FIXED = "fixed"  # camera name: the task's first one except the endoscope
# Numeric of a task's MJCF: the contact solver's largest number of iterations, for light bodies.
SOLVER_ITERATIONS = "solver_turns"


class BoundArm(NamedTuple):
    """An arm with its tool in a compiled model.

    Attributes:
      arm, tool, mount: its records.
      chain: from the world to the tcp, or to the shaft before a wrist, its trocar at the nominal
        place; see `chain_at`.
      base_offset: `[3]` m, from the trocar to the base of an arm that stands there.
      joints: number of the chain's joints; the J of the following fields has those of a wrist too.
      home: `[J]` rad. max_speed: `[J]` rad/s.
      q, dof, ctrl: `[J]` indices of its joints in qpos, qvel and ctrl.
      jaws: indices of the jaws' joints in qpos.
      jaw: index of the joint that measures the opening, or None.
      jaw_ctrl: of the jaws' servo, or None.
      pads: geom ids.
    """

    arm: Arm
    tool: Tool
    mount: Mount
    chain: ik.Chain
    base_offset: np.ndarray
    joints: int
    home: np.ndarray
    max_speed: np.ndarray
    q: np.ndarray
    dof: np.ndarray
    ctrl: np.ndarray
    jaws: np.ndarray
    jaw: int | None
    jaw_ctrl: int | None
    pads: np.ndarray


class Scene(NamedTuple):
    """A compiled scene: all that never varies in an environment.

    Attributes:
      names: of the parts.
      task: its record. bound: the ids that it resolved.
      mj_model: the C model; `mjx_model`: its MJX copy; `mjx_data`: a template of the state.
      arms: one per slot of the task.
      p_world_ref: `[A, 3]` m, nominal trocars. roll_zero: `[A]` rad, see `rcm.TrocarFrame`.
      trocar_mocap: `[A]` mocap bodies that mark the trocars.
      still_mocap: `[K]` mocap bodies of `Task.still`.
      graspable: geom ids. geom_rgb: `[G, 3]` colours.
      max_solver_iterations: of the contact solver, or None for `solver.MAX_ITERATIONS`.
    """

    names: SceneNames
    task: Task
    bound: Any
    mj_model: mujoco.MjModel
    mjx_model: mjx.Model
    mjx_data: mjx.Data
    arms: tuple[BoundArm, ...]
    p_world_ref: np.ndarray
    roll_zero: np.ndarray
    trocar_mocap: np.ndarray
    still_mocap: np.ndarray
    graspable: np.ndarray
    geom_rgb: np.ndarray
    max_solver_iterations: int | None


def name(
    task: str = DEFAULT_TASK,
    arms: Sequence[str] = (),
    tools: Sequence[str] = (),
    cameras: Sequence[str] = (),
) -> SceneNames:
    """Completes a scene's names with the task's defaults; cameras may be `FIXED`.

    Raises:
      errors.UsageError: a name is unknown, or there are not as many as the task has slots.
    """
    record: Task = registries.tasks.get(task)
    requests = {"arm": (arms, registries.arms), "tool": (tools, registries.tools)}
    chosen = {}
    for kind, (names, known) in requests.items():
        names = tuple(names) or tuple(getattr(slot, kind) for slot in record.slots)
        if len(names) == 1:  # the same for all
            names *= record.arms
        if len(names) != record.arms:
            raise errors.UsageError(kind, f"{record.arms} for {task}", " ".join(names))
        for one in names:
            errors.choice(kind, one, known.names())
        chosen[kind] = names
    still = next((one for one in record.cameras if one != endoscope_camera.NAME), FIXED)
    cameras = tuple(still if one == FIXED else one for one in cameras) or record.cameras[:1]
    observed = [one for one in record.cameras if one != endoscope_camera.NAME]
    for one in cameras:
        scopes = [f"{scope}{TISSUE}" for scope in record.cameras if scope not in observed]
        views = [*record.cameras, *derived_views.names(observed), *scopes]
        errors.choice("camera", one, dict.fromkeys(views))
    return SceneNames(task, chosen["arm"], chosen["tool"], cameras)


def compose(names: SceneNames, variant: Task | None = None) -> mujoco.MjModel:
    """Compiles the C model of a scene; `variant` as in `load`.

    Raises:
      errors.UsageError: no mount of an arm with its tool is known for the task's workspace, no part
        has a camera that is observed, or an arm's part lacks something, see `robot.read`.
    """
    task, part = variant or registries.tasks.get(names.task), f"task {names.task}"
    world = mjcf_parts.read(part, task.mjcf)
    limits = mjcf_parts.take_limits(world)
    for i, (arm, tool, mount) in enumerate(_mounted(task, names)):
        whole, hand = robot.read(arm), mjcf_parts.read(f"tool {tool.name}", tool.mjcf)
        for spec in (whole, hand):
            limits = limits + mjcf_parts.take_limits(spec)
        held = whole.attach(hand, site=whole.site(robot.FLANGE), prefix="tool/")
        held.quat = _about_z(mount.turn)  # from the flange on, however its file turns that
        trocar = world.body(f"trocar{i}")
        if trocar is None or not trocar.mocap:
            raise errors.UsageError(part, f"a mocap body trocar{i} in its MJCF", "none")
        parent = trocar if arm.remote_centre else world.worldbody
        base = parent.add_site(
            name=f"base{i}", pos=mount.position, quat=mount.wxyz_base, group=3, size=[0.003] * 3
        )
        world.attach(whole, site=base, prefix=f"arm{i}/")
        _call_by_name(world, f"arm{i}/tool/")
    if scope := endoscope_camera.of(task, names.cameras):
        endoscope_camera.add(world, scope)
    known = [camera.name for camera in world.cameras]
    for camera in names.cameras:
        errors.choice("camera", derived_views.parse(camera, known).camera, known)
    for limit, size in zip(mjcf_parts.CONTACT_LIMITS, limits):
        world.add_numeric(name=limit, data=[float(size)], size=1)
    with mjcf_parts.explained(part):
        model = world.compile()
    if model.nv >= SPARSE_FROM:
        model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    return model


def load(names: SceneNames, variant: Task | None = None) -> Scene:
    """Loads a scene: its model in MJX and its ids.

    Args:
      variant: of the task, with the same slots, in its place.
    """
    task, part = variant or registries.tasks.get(names.task), f"task {names.task}"
    if names.task not in registries.tasks.built_in:
        task = contract.guarded(task)
    task = wrists.holding(task, names)
    m = compose(names, task)
    # XLA's MJX implementation everywhere: the warp one needs CUDA.
    device = jax.local_devices()[0]  # MJX alone takes the first of all, another process's
    with mjcf_parts.explained(part):
        mjx_model = mjx.put_model(m, device=device, impl="jax")
        mjx_data = mjx.make_data(m, device=device, impl="jax")
        solver.check(mjx_model, mjx_data)
    mounted = _mounted(task, names)
    return Scene(
        names=names,
        task=task,
        bound=task.bind(m),
        mj_model=m,
        mjx_model=mjx_model,
        mjx_data=mjx_data,
        arms=tuple(_bind(m, i, *parts) for i, parts in enumerate(mounted)),
        p_world_ref=np.array([slot.p_world_ref for slot in task.slots], np.float32),
        roll_zero=np.array([slot.roll_zero for slot in task.slots], np.float32),
        trocar_mocap=np.array([m.body(f"trocar{i}").mocapid[0] for i in range(task.arms)]),
        still_mocap=np.array([m.body(f"still{i}").mocapid[0] for i in range(_still(m))], int),
        graspable=mjcf_parts.ids(f"{part}: graspable", m, "geom", list(task.graspable)),
        geom_rgb=geometry.geom_rgb(m),
        max_solver_iterations=_max_solver_iterations(m),
    )


def chain_at(bound: BoundArm, p_world_trocar: jax.Array) -> ik.Chain:
    """Returns the chain of an arm whose trocar is at `p_world_trocar` `[3]` m."""
    if not bound.arm.remote_centre:
        return bound.chain
    return bound.chain.replace(p_base=p_world_trocar + bound.base_offset)


def marked(task: Task, bound: Any, labels: Mapping[str, Any], rgb: Any) -> Any:
    """Returns the colours `[G, 3]` with the goal marked, if an episode's labels determine it."""
    try:
        return task.colours(bound, types.SimpleNamespace(**labels), rgb)
    except AttributeError:  # the task's colours depend on parts of the layout that labels lack
        return rgb


def tcp(i: int, tool: Tool) -> str:
    """Returns the name of the site at arm i's tip in the composed model."""
    return f"arm{i}/tool/{tool.tcp}"


def _mounted(task: Task, names: SceneNames) -> list[tuple[Arm, Tool, Mount]]:
    parts = []
    for slot, arm_name, tool_name in zip(task.slots, names.arms, names.tools, strict=True):
        arm, tool = registries.arms.get(arm_name), registries.tools.get(tool_name)
        mount = registries.mount(arm, tool_name, slot.workspace)
        if mount is None:
            known = ", ".join(" in ".join(key) for key in arm.mounts)
            raise errors.UsageError(
                f"arm {arm_name}",
                f"a mount with the tool {tool_name} in the workspace {slot.workspace}",
                known or "none",
                f"starjax find-mount {arm_name} {tool_name} {task.name} searches one",
            )
        parts.append((arm, tool, mount))
    return parts


def _bind(m: mujoco.MjModel, i: int, arm: Arm, tool: Tool, mount: Mount) -> BoundArm:
    at = f"arm{i}/"
    names = tuple(at + joint for joint in arm.joints)
    chain = chain_of(m, first=at + arm.first, site=at + f"tool/{tool.base}", joints=names)
    wrist = tuple(f"{at}tool/{joint}" for joint in tool.wrist_joints)
    joints = [m.joint(name) for name in names + wrist]
    held = [m.joint(j) for j in range(m.njnt) if m.joint(j).name.startswith(f"{at}tool/")]
    jaws = [joint for joint in held if joint.name not in wrist]
    return BoundArm(
        arm=arm,
        tool=tool,
        mount=mount,
        chain=chain,
        base_offset=np.array(chain.p_base - m.body(f"trocar{i}").pos, np.float32),
        joints=len(names),
        home=np.array(mount.home + (0.0,) * len(wrist), np.float32),
        max_speed=np.array(arm.max_speed + (tool.wrist_speed,) * len(wrist), np.float32),
        q=np.array([joint.qposadr[0] for joint in joints]),
        dof=np.array([joint.dofadr[0] for joint in joints]),
        ctrl=np.array([m.actuator(name).id for name in names + wrist]),
        jaws=np.array([joint.qposadr[0] for joint in jaws], int),
        jaw=None if tool.jaw is None else int(m.joint(f"{at}tool/{tool.jaw}").qposadr[0]),
        jaw_ctrl=None if tool.servo is None else int(m.actuator(f"{at}tool/{tool.servo}").id),
        pads=np.array([m.geom(f"{at}tool/{pad}").id for pad in tool.pads], int),
    )


def _call_by_name(world: mujoco.MjSpec, prefix: str) -> None:
    """Renames a tool's cameras without the prefix, unless that name exists."""
    taken = {camera.name for camera in world.cameras}
    for camera in list(world.cameras):
        own = camera.name.removeprefix(prefix)
        if own not in taken:
            camera.name = own


def _max_solver_iterations(m: mujoco.MjModel) -> int | None:
    row = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_NUMERIC, SOLVER_ITERATIONS)
    return None if row < 0 else int(m.numeric(row).data[0])


def _still(m: mujoco.MjModel) -> int:
    return sum(m.body(b).name.startswith("still") for b in range(m.nbody))


def _about_z(angle: float) -> list[float]:
    return [float(np.cos(angle / 2)), 0.0, 0.0, float(np.sin(angle / 2))]
