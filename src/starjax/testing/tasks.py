"""Checks of a task: record, model, results of its functions, contact bits, draws, experts."""

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from starjax import rcm
from starjax.core import config, errors
from starjax.core.types import ArrayTree, Pose
from starjax.data import stillness
from starjax.evaluation import expert as episodes
from starjax.sim import contract, coupling, physics, registries, sampling, task_draws
from starjax.sim import env as envs
from starjax.sim.rollouts.success_quota import MIN_SUCCESS_RATE
from starjax.sim.scene import Scene
from starjax.sim.state import EnvState
from starjax.sim.task import CONTROL_HZ, SimReadings, Task
from starjax.testing import task_starts
from starjax.testing.base import (
    FAILED,
    NOTE,
    Check,
    attempt,
    counted,
    failed,
    not_finite,
    outside,
    verdict,
)

SEED = 0
MAX_RCM_ERROR = 1e-3  # m, executed by an expert
MAX_APART = 0.02  # m, from an expert's executed tip to its recorded one: a disturbance to correct
FARTHEST = 1.0  # m from the world's origin to a nominal trocar


def check(name: str, n: int) -> Iterator[Check]:
    """Yields the checks of a task with its default arms and tools.

    Args:
      n: episodes of each expert.
    """
    fault, task = attempt("record", lambda: contract.guarded(registries.tasks.get(name)))
    if fault:
        yield fault
        return
    yield Check("record", f"arms {task.arms}, cameras {len(task.cameras)}, state {task.state_size}")
    fault, env = attempt("model", lambda: envs.make(name, observation="state", variant=task))
    if fault:
        yield fault
        return
    m = env.scene.mj_model
    yield Check("model", f"{m.ngeom} geoms, {m.nq} coordinates, {m.nu} servos")
    results = [*_functions(env.scene)]
    if all(result.status != FAILED for result in results):
        results += [verdict("ranges", ranges(task), "of the record"), *task_starts.check(env)]
    is_sound = all(result.status != FAILED for result in results)
    yield from results
    yield verdict("contacts", _untouchable(env.scene), f"{len(task.graspable)} graspable geoms")
    if is_sound:
        yield verdict("draws", _draws(env.scene), "equal with one key, finite")
        for variant in task.experts:
            yield from _expert(env, variant, n)


def ranges(task: Task) -> Iterator[str]:
    """Yields faults of a task's numbers: NaN, and lengths that are not in m."""
    yield from not_finite(task)
    for i, slot in enumerate(task.slots):
        far = float(np.abs(slot.p_world_ref).max())
        if far > FARTHEST:
            yield f"slots[{i}].p_world_ref: expected within {FARTHEST:g} m, got {far:g}: mm?"
    limits = {"radius": (0.0, 0.2), "polar": (0.0, np.pi), "azimuth": (-2 * np.pi, 2 * np.pi)}
    yield from outside(task.trocars, limits, "m or rad")
    yield from outside(task, {"floor": (-FARTHEST, FARTHEST)})
    sizes = {"rot6d": 6, "point": 3}
    for field in task.fields:
        if field.kind in sizes and field.size % sizes[field.kind]:
            yield f"fields: {field.name} of kind {field.kind} has {field.size} numbers"


def _functions(scene: Scene) -> Iterator[Check]:
    """Yields a check of each function, traced with the shapes of the scene."""
    task, bound, m = scene.task, scene.bound, scene.mj_model
    contacts = jax.eval_shape(lambda: physics.no_contacts(scene))
    arms = task.arms

    def readings() -> SimReadings:
        pose = Pose(jnp.zeros((arms, 3, 3)), jnp.zeros((arms, 3)))
        still, no = jnp.zeros((arms, 3)), jnp.zeros(arms, bool)
        touched = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), contacts)
        q, v = jnp.zeros(m.nq), jnp.zeros(m.nv)
        memory = None
        if task.coupling is not None:
            _, memory = task.coupling.begin(bound, layout(), q, pose)
        return SimReadings(q, v, pose, still, jnp.zeros(arms), no, touched, memory)

    def layout() -> Any:
        return task.sample(bound, jax.random.key(0))

    def measured() -> Any:
        return task.measure(bound, layout(), readings(), None)

    tips, rgb = jnp.zeros((arms, 3)), jnp.asarray(scene.geom_rgb)
    calls = {
        "sample": layout,
        "tips": lambda: task.tips(bound, layout(), tips),
        "place_objects": lambda: task.place_objects(bound, jnp.zeros(m.nq), layout()),
        "measure": lambda: task.measure(bound, layout(), readings(), measured()),
        "status": lambda: task.status(bound, layout(), measured()),
        "state": lambda: task.state(bound, layout(), measured()),
        "relative": lambda: task.relative(jnp.zeros(task.state_size), tips),
        "label": lambda: task.label(layout()),
        "colours": lambda: task.colours(bound, layout(), rgb),
        "obstacles": lambda: task.obstacles(bound, layout(), measured()),
        "is_sound": lambda: task.is_sound(bound, jnp.zeros(m.nq), jnp.zeros(m.nv)),
        "drive": lambda: task.drive(bound, layout(), jnp.zeros(m.nu), jnp.zeros(())),
    }
    if task.still is not None:
        calls["still"] = lambda: task.still and task.still(layout())
    if task.coupling is not None:
        calls["coupling"] = lambda: _forces(scene, layout())
    faults = set()
    for name, call in calls.items():
        fault, _ = attempt(name, lambda call=call: jax.eval_shape(call))
        if fault and fault.text not in faults:  # that of `sample` returns with every other one
            faults.add(fault.text)
            yield fault
    fault, _ = attempt("outline", lambda: task.outline(m))
    if fault:
        yield fault
    elif not faults:
        yield Check("functions", f"{len(calls) + 1} return their types and shapes")


def _forces(scene: Scene, layout: ArrayTree) -> jax.Array:
    """Returns the forces `[V]` of a task's own at reset; raises for another shape."""
    state = physics.initial(scene, [jnp.asarray(bound.home) for bound in scene.arms], layout)
    p_world_trocar, gripper = jnp.asarray(scene.p_world_ref), -jnp.ones(len(scene.arms))
    forces, _ = coupling.forces(scene, layout, state, gripper, p_world_trocar)
    assert forces is not None, "a task without forces of its own"
    if jnp.shape(forces) != (scene.mj_model.nv,):
        raise errors.UsageError(
            f"task {scene.task.name}: coupling.forces",
            f"an array [{scene.mj_model.nv}]",
            str(list(jnp.shape(forces))),
        )
    return forces


def _untouchable(scene: Scene) -> Iterator[str]:
    """Yields the graspable geoms that no pad can touch."""
    m = scene.mj_model
    pads = [int(pad) for bound in scene.arms for pad in bound.pads]
    listed = {frozenset(pair) for pair in zip(m.pair_geom1.tolist(), m.pair_geom2.tolist())}
    for geom in map(int, scene.graspable):
        if not any(_collide(m, geom, pad) or frozenset((geom, pad)) in listed for pad in pads):
            yield (
                f"{m.geom(geom).name} has contype {m.geom_contype[geom]}, conaffinity "
                f"{m.geom_conaffinity[geom]}: no pad touches it; pads of starjax touch bit 4"
            )


def _collide(m: mujoco.MjModel, a: int, b: int) -> bool:
    return bool(
        (m.geom_contype[a] & m.geom_conaffinity[b]) | (m.geom_contype[b] & m.geom_conaffinity[a])
    )


def _draws(scene: Scene) -> list[str]:
    """Returns draws that differ between two resets with one key, or are not finite."""
    return [f"{function} {text}" for function, text in task_draws.faults(scene)]


def _expert(env: envs.Env, variant: str, n: int) -> Iterator[Check]:
    """Yields the checks of `n` episodes of an expert."""
    subject = f"expert {variant}"
    key_trocars, key = jax.random.split(jax.random.key(SEED))
    listed = len(env.task.is_seen)
    trocars = rcm.Trocar(*(jnp.resize(jnp.asarray(f), (n, f.shape[1])) for f in env.task.trocars))
    if n > listed:  # the task's own ones first, then others of its region
        drawn = sampling.sample_trocars(key_trocars, env.task, (n - listed,))
        trocars = jax.tree.map(
            lambda a, b: jnp.concatenate([jnp.asarray(a), b]), rcm.Trocar(*env.task.trocars), drawn
        )
    steps = round(env.task.time_limit_s * CONTROL_HZ)
    fault, agent = attempt(subject, lambda: contract.expert(env.task, variant))
    if not fault:
        fault, ran = attempt(subject, lambda: episodes.run(env, agent, trocars, key, steps))
    if fault:
        yield fault
        return
    yield from _outcomes(env, subject, ran)


def _outcomes(env: envs.Env, subject: str, ran: episodes.ExpertEpisodes) -> Iterator[Check]:
    last, success = ran.last, np.asarray(ran.last.success)
    figures, count = episodes.summary(ran, env), len(success)
    text = f"{success.sum()} of {count} succeed"
    if success.any():
        text += f", in {figures['median_transfer_s']:.1f} s"
    text += f", RCM error up to {figures['rcm_error_mm']['max']:.2g} mm"
    usual = config.DemosConfig().max_steps
    late = int((last.step[success] > max(usual, env.task.least_steps)).sum())
    if figures["rcm_error_mm"]["max"] > 1e3 * MAX_RCM_ERROR:
        yield failed(subject, f"{text}; shafts stay within {1e3 * MAX_RCM_ERROR:g} mm of trocars")
    elif success.mean() < MIN_SUCCESS_RATE:
        yield failed(subject, f"{text}; collecting needs {MIN_SUCCESS_RATE:.0%}")
    else:
        yield Check(subject, text)
    if late:
        yield Check(subject, f"{late} take more than --demos.max-steps {usual}", NOTE)
    if figures["resting"] > stillness.RARELY * success.sum():
        text = (
            f"stands still for up to {figures['longest_rest']} control steps, in "
            f"{figures['resting']} of {success.sum()} successes for more than {stillness.MOST}: a "
            "policy waits there; end phases by events"
        )
        yield failed(subject, text)
    yield verdict(f"{subject}, goal", task_starts.hidden_goals(env, ran.last), "in the state")
    yield verdict(f"{subject}, reward", task_starts.unrewarded(env, ran.last), "more at success")
    apart = float(ran.apart.max())
    text = f"up to {1e3 * apart:.1f} mm from executed ones"
    faults = [f"{text}, at most {1e3 * MAX_APART:g} mm"] * (not apart <= MAX_APART)
    yield verdict(f"{subject}, recorded commands", faults, text)
    if not ran.finite.all():
        yield failed(subject, f"{_fields(env, ran)} in {int((~ran.finite).sum())} episodes")
    waiting = ~(success | last.lost | last.invalid)
    ends = {
        "lost": int(last.lost.sum()),
        "too late": int(waiting.sum()),
        "invalid": int(last.invalid.sum()),
    }
    if not success.all():
        stages = {f"at {env.task.stages[i]}": int(c) for i, c in _stages(last, ~success).items()}
        text = counted({name: c for name, c in ends.items() if c})
        yield Check(f"{subject}, failures", f"{text}; {counted(stages)}", NOTE)
    if causes := episodes.faults(env.scene, ran):
        yield Check(f"{subject}, invalid", counted(causes), NOTE)
    if pairs := episodes.collisions(env.scene, ran):
        yield Check(f"{subject}, collided", counted(pairs), NOTE)


def _stages(last: EnvState, which: np.ndarray) -> dict[int, int]:
    return dict(zip(*np.unique(np.asarray(last.stage)[which], return_counts=True), strict=True))


def _fields(env: envs.Env, ran: episodes.ExpertEpisodes) -> str:
    """Returns the fields of the state that are not finite at the end of an episode."""
    task: Task = env.task
    last = ran.last
    states = jax.vmap(lambda *of: task.state(env.scene.bound, *of))(last.layout, last.measurements)
    ends = np.cumsum([field.size for field in task.fields])
    parts = np.split(np.asarray(states), ends[:-1], axis=1)
    names = [f.name for f, x in zip(task.fields, parts) if not np.isfinite(x).all()]
    return f"state: {', '.join(names) or 'a field'} not finite"
