"""Pads on the segment with the needle's point: our reduced contacts against all of C MuJoCo's.

    python benchmarks/bench_point.py [--per-trocar 2] [--task needle_pick] [--arm fr5]

The expert's episodes run in C MuJoCo. At every control step at which the jaws hold the needle the
contacts are found twice from the same state: all of them, and those that our physics keeps. A step
counts if one of the pads overlaps that segment. Its distance from the point is that of the deepest
contact, along the segment. Rows: the expert as it is, and one that takes the next segment too, as
with a straight tool. At the end of each episode that holds the needle, the needle is also slid
through the jaws: along the wire, how far from the point is their middle when from there on each
set has pads on that segment? No time.
"""

import argparse
import functools
from collections.abc import Callable
from typing import Any

import _c_env
import _scene
import _timing
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from starjax import rcm, runtime
from starjax.addons.suture.needle_regrasp import task as regrasp
from starjax.core.types import Agent, Pose
from starjax.sim import bodies, registries
from starjax.sim import env as envs
from starjax.sim import scene as scenes
from starjax.sim.quiet_mjx import mjx
from starjax.sim.task import Contacts
from starjax.tasks.needle_pick import task

STEPS = 240  # control steps, 8 s: all grasps are over
SEED = 2026
TASK, TOOL = "needle_pick", "needle_driver"
SLIDES = 200  # places of the needle in the jaws


def main() -> None:
    runtime.prepare_xla()
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--per-trocar", type=int, default=2)
    _scene.add_flags(parser)
    parser.set_defaults(task=TASK, tool=[TOOL])
    asked = parser.parse_args()
    env = _scene.make(asked, observation="state")
    rows = {
        "expert": compare(env, env.task.expert(), asked.per_trocar),
        "next_segment": compare(env, _straight(env.task.expert()), asked.per_trocar),
    }
    for name, row in rows.items():
        print(name, row)
    name = _scene.result_name("point", env.names)
    _timing.report(name, {"seed": SEED, "scene": env.names._asdict(), "results": rows}, tiny=False)


def _straight(agent: Agent) -> Agent:
    """Returns the expert that sees a tool without a wrist, and so takes any inner segment."""
    return Agent(
        lambda key, state: agent.init(key, state.replace(wrist=None)),
        lambda memory, state: agent.act(memory, state.replace(wrist=None)),
    )


def compare(env: envs.Env, agent: Agent, per_trocar: int) -> dict[str, Any]:
    """Returns counts of episodes and steps in which each set of contacts has pads on the point."""
    qpos, touch, at, success = episodes(env, agent, per_trocar)
    found, off = [], []
    for lane, step in np.argwhere(touch):
        whole, away = _all(env, qpos[lane, step], at[lane])
        found.append((lane, whole))
        off += [away] if whole else []
    lanes, whole = (np.array(x) for x in zip(*found))
    on_point = jax.jit(jax.vmap(functools.partial(_on_point, env)))
    kept = np.asarray(on_point(qpos[touch], at[lanes]))
    ends = [(qpos[lane, -1], at[lane]) for lane in np.flatnonzero(touch[:, -1])]
    slid = np.array([slide(env, *end, on_point) for end in ends])
    return {
        "episodes": len(qpos),
        "successes": int(success.sum()),
        "steps": len(whole),
        "steps_all": int(whole.sum()),
        "steps_kept": int(kept.sum()),
        "steps_kept_alone": int((kept & ~whole).sum()),
        "episodes_all": len(set(lanes[whole])),
        "episodes_kept": len(set(lanes[kept])),
        "from_point_mm": 1e3 * min(off) if off else None,
        "slid": len(slid),
        "middle_from_point_all_mm": quantiles(slid[:, 0]),
        "middle_from_point_kept_mm": quantiles(slid[:, 1]),
    }


def quantiles(values: np.ndarray) -> list[float]:
    """Returns the smallest, the median and the largest (mm) of values (m)."""
    return [1e3 * float(x) for x in np.quantile(values, (0.0, 0.5, 1.0))]


def slide(
    env: envs.Env, qpos: np.ndarray, at: np.ndarray, on_point: Callable[..., jax.Array]
) -> tuple[float, float]:
    """Returns how far from the point (m of wire) the jaws' middle is when they are on the segment.

    The needle turns about its arc's centre; the first is of all contacts, the second of ours.
    """
    m, bound = env.scene.mj_model, env.scene.bound
    data = mujoco.MjData(m)
    data.qpos[:], data.mocap_pos[env.scene.trocar_mocap] = qpos, at
    mujoco.mj_fwdPosition(m, data)
    tip = data.site(scenes.tcp(0, registries.tools.get(env.names.tools[0]))).xpos
    needle = bodies.free_pose(jnp.asarray(qpos), bound.needle)
    angle = float(regrasp.wire_angle(needle, jnp.asarray(tip, jnp.float32)))
    angles = angle + (0.5 * task.SWEEP - angle) * np.linspace(0.0, 1.0, SLIDES)
    moved = np.stack([_turned(needle, angle - to) for to in angles])
    states = np.repeat(qpos[None], len(angles), 0)
    states[:, bound.needle : bound.needle + 7] = moved
    whole = np.array([_all(env, state, at)[0] for state in states])
    kept = np.asarray(on_point(states, np.repeat(at[None], len(states), 0)))
    off = task.RADIUS * (0.5 * task.SWEEP - angles)
    return tuple(float(off[always(found)]) for found in (whole, kept))


def always(found: np.ndarray) -> int:
    """Returns the place `[200]` from which on all are found, the last one if none is."""
    return min(len(found) - 1, int(np.flatnonzero(np.append(True, ~found[:-1]))[-1]))


def _turned(needle: Pose, turn: float) -> np.ndarray:
    """Returns the coordinates `[7]` of a needle turned about its arc's centre."""
    R = needle.R @ rcm.rotation_z(jnp.asarray(turn))
    return np.asarray(bodies.free_coords(Pose(R, needle.p + (needle.R - R) @ regrasp._CENTRE)))


def episodes(env: envs.Env, agent: Agent, per_trocar: int) -> tuple[np.ndarray, ...]:
    """Returns qpos `[N, T, Q]`, touch `[N, T]`, trocars `[N, A, 3]` m and success `[N]`."""
    c_env = _c_env.with_c_physics(env)
    trocars = jax.tree.map(
        lambda field: jnp.repeat(jnp.asarray(field), per_trocar, axis=0), env.task.trocars
    )
    keys = jax.random.split(jax.random.key(SEED), len(trocars.radius))

    @jax.jit
    @jax.vmap
    def play(key: jax.Array, trocar: Any) -> Any:
        start, choices = jax.random.split(key)
        state = env.reset(start, envs.EnvParams(trocar))

        def step(carry: Any, _: None) -> Any:
            state, memory = carry
            command, memory, _ = agent.act(memory, state)
            state = c_env.step(state, command)
            return (state, memory), (state.physics.qpos, state.touch[0], state.success)

        first = (state, agent.init(choices, state))
        (last, _), (qpos, touch, _) = jax.lax.scan(step, first, length=STEPS)
        return qpos, touch, last.trocar.p_world_trocar, last.success

    return tuple(np.asarray(leaf) for leaf in play(keys, trocars))


def _all(env: envs.Env, qpos: np.ndarray, at: np.ndarray) -> tuple[bool, float]:
    """Returns True if a pad overlaps the segment with the point, and the distance (m) from it."""
    m, bound = env.scene.mj_model, env.scene.bound
    data = mujoco.MjData(m)
    data.qpos[:], data.mocap_pos[env.scene.trocar_mocap] = qpos, at
    mujoco.mj_fwdPosition(m, data)
    on = [
        c
        for c in data.contact
        if c.dist < 0 and set(c.geom) & set(bound.point) and set(c.geom) & set(bound.pads)
    ]
    if not on:
        return False, np.nan
    deepest = min(on, key=lambda c: c.dist)
    wire = next(g for g in deepest.geom if g in bound.point)
    middle, along = data.geom_xpos[wire], data.geom_xmat[wire].reshape(3, 3)[:, 2]
    next_to_it = data.geom(f"wire{task.SEGMENTS - 2}a").xpos
    back = along * np.sign((next_to_it - middle) @ along)  # away from the point
    return True, float(m.geom_size[wire, 1] + (deepest.pos - middle) @ back)


def _on_point(env: envs.Env, qpos: jax.Array, at: jax.Array) -> jax.Array:
    """Returns True if the contacts of our physics have a pad on the segment with the point."""
    scene = env.scene
    mocap_pos = scene.mjx_data.mocap_pos.at[scene.trocar_mocap].set(at)
    data = scene.mjx_data.replace(qpos=qpos, mocap_pos=mocap_pos)
    data = mjx.collision(scene.mjx_model, mjx.kinematics(scene.mjx_model, data))
    contacts = Contacts(jnp.asarray(data._impl.contact.geom), data._impl.contact.dist)
    return bodies.touch(contacts, scene.bound.point, scene.bound.pads)


if __name__ == "__main__":
    main()
