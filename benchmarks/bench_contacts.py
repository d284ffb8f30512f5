"""Wrench on a needle from all contacts of the pads, and from reduced sets of them, in C MuJoCo.

    python benchmarks/bench_contacts.py [--task needle_pick] [--steps 200]

An expert's episode runs in C MuJoCo with all contacts. In every step in which a pad touches the
wire, the constraint forces are solved again from the same state with fewer contacts. The error is
the distance of the resulting force and torque on the needle from those of all contacts.

nearest    the contacts of the four nearest pairs of a capsule and a pad, as our physics keeps them
ends       of each pad the deepest contact, and the outermost two along the wire
tips       of each pad the outermost two
moments    of each pad four weighted points of its face in place of all contacts, with the sums of
           their stiffnesses, depths, and first and second moments
"""

import argparse
from collections.abc import Callable
from typing import Any, NamedTuple

import _c_env
import _timing
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from starjax import runtime
from starjax.sim import env as envs
from starjax.sim.scene import Scene

PAIRS = 4  # limit of the broad phase: `max_geom_pairs` of the needle's MJCF
NEEDLE = "needle"
POINTS = 4  # points of a pad, in place of all its contacts


class Point(NamedTuple):
    """A contact in place of several: `p` `[3]` m, `dist` m, `weight` of its stiffness."""

    p: np.ndarray
    dist: float
    weight: float


# (data, contacts of the pads) -> the kept ones, or the points in place of some of them.
Keep = Callable[[Any, list[tuple[int, int]]], np.ndarray | dict[int, Point]]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--task", default="needle_pick")
    parser.add_argument("--steps", type=int, default=200, help="control steps of the episode")
    asked = parser.parse_args()
    runtime.prepare_xla()
    env = envs.make(asked.task, observation="state")
    states = episode(env, asked.steps)
    found = {name: [] for name in KEEPS}
    counts = {name: [] for name in ("all", *KEEPS)}
    for state in states:
        compare(env.scene, state, found, counts)
    rows = {}
    print("set  contacts, mean and most  force error, N: p50 p99  torque error, N mm: p50 p99")
    for name, errors in found.items():
        error = np.array(errors)
        quantiles = np.quantile(error[:, :2], (0.5, 0.99), axis=0)
        rows[name] = {
            "contacts_mean": float(np.mean(counts[name])),
            "contacts_max": int(np.max(counts[name])),
            "force_error_N": {"p50": quantiles[0, 0], "p99": quantiles[1, 0]},
            "torque_error_Nmm": {"p50": 1e3 * quantiles[0, 1], "p99": 1e3 * quantiles[1, 1]},
            "force_N": float(np.median(error[:, 2])),
            "torque_Nmm": float(1e3 * np.median(error[:, 3])),
        }
        print(name, rows[name])
    whole = {"mean": float(np.mean(counts["all"])), "max": int(np.max(counts["all"]))}
    print(f"steps with contact: {len(counts['all'])}; contacts of all: {whole}")
    content = {"task": asked.task, "steps": len(counts["all"]), "contacts": whole}
    _timing.report("contacts", {**content, "results": rows}, tiny=False)


def episode(env: envs.Env, steps: int) -> list[Any]:
    """Returns (qpos, qvel, ctrl, trocars, warm start) before every substep of an expert."""
    states: list[Any] = []
    plain = mujoco.mj_step

    def step(m: Any, data: Any) -> None:
        here = (data.qpos, data.qvel, data.ctrl, data.mocap_pos, data.qacc_warmstart)
        states.append([x.copy() for x in here])
        plain(m, data)

    c_env, expert = _c_env.with_c_physics(env), env.task.expert()
    trocar = jax.tree.map(lambda leaf: jnp.asarray(leaf)[1], env.task.trocars)

    @jax.jit
    def play(key: jax.Array) -> Any:
        start, choices = jax.random.split(key)
        state = env.reset(start, envs.EnvParams(trocar))

        def advance(_: Any, carry: Any) -> Any:
            state, memory = carry
            command, memory, _ = expert.act(memory, state)
            return c_env.step(state, command), memory

        carry = (state, expert.init(choices, state))
        return jax.lax.fori_loop(0, steps, advance, carry)[0].success

    mujoco.mj_step = step
    try:
        print("success:", bool(play(jax.random.key(0))))
    finally:
        mujoco.mj_step = plain
    return states


def compare(scene: Scene, state: Any, found: dict, counts: dict) -> None:
    """Adds the errors of all reduced sets in one state."""
    m = scene.mj_model
    data = mujoco.MjData(m)
    m.opt.iterations, m.opt.ls_iterations, m.opt.tolerance = 100, 100, 1e-12
    whole, contacts = wrench(m, data, state, None)
    if not contacts:
        return
    counts["all"].append(len(contacts))
    reduced = {name: keep(data, contacts) for name, keep in KEEPS.items()}
    for name, kept in reduced.items():
        part, _ = wrench(m, data, state, kept)
        error = part - whole
        sizes = [np.linalg.norm(x) for x in (error[:3], error[3:], whole[:3], whole[3:])]
        found[name].append(sizes)
        counts[name].append(len(kept))


def wrench(m: Any, data: Any, state: Any, kept: Any) -> tuple[np.ndarray, list[tuple[int, int]]]:
    """Returns the constraints' force and torque on the needle, and (contact, pad) of the pads.

    Args:
      m, data: of C MuJoCo.
      state: see `episode`.
      kept: contacts of the pads with the wire that take part, and perhaps their changed points;
        None for all.
    """
    for target, value in zip(
        (data.qpos, data.qvel, data.ctrl, data.mocap_pos, data.qacc_warmstart), state
    ):
        target[:] = value
    for stage in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_crb, mujoco.mj_factorM):
        stage(m, data)
    mujoco.mj_collision(m, data)
    needle = m.body(NEEDLE).id
    contacts = []
    for i in range(data.ncon):
        pair = data.contact.geom[i]
        bodies = [int(m.geom_bodyid[g]) for g in pair]
        pads = [int(g) for g, body in zip(pair, bodies) if body != needle and body != 0]
        if needle in bodies and pads and data.contact.dist[i] < 0:
            contacts.append((i, pads[0]))
            if kept is not None and i not in kept:
                data.contact[i].exclude = 1
    points = kept if isinstance(kept, dict) else {}
    for i, point in points.items():
        data.contact[i].pos[:], data.contact[i].dist = point.p, point.dist
    mujoco.mj_makeConstraint(m, data)
    for i, point in points.items():
        rows = slice(data.contact[i].efc_address, data.contact[i].efc_address + 3)
        data.efc_D[rows] *= point.weight
        data.efc_R[rows] /= point.weight
    for stage in (mujoco.mj_projectConstraint, mujoco.mj_transmission):
        stage(m, data)
    mujoco.mj_fwdVelocity(m, data)
    mujoco.mj_fwdActuation(m, data)
    mujoco.mj_fwdAcceleration(m, data)
    mujoco.mj_fwdConstraint(m, data)
    first = m.jnt_dofadr[m.body_jntadr[needle]]
    return data.qfrc_constraint[first : first + 6].copy(), contacts


def _nearest(data: Any, contacts: list[tuple[int, int]]) -> np.ndarray:
    pairs: dict[tuple[int, int], float] = {}
    for i, _ in contacts:
        a, b = map(int, data.contact.geom[i])
        pairs[a, b] = float(np.linalg.norm(data.geom_xpos[a] - data.geom_xpos[b]))
    near = sorted(pairs, key=lambda pair: pairs[pair])[:PAIRS]
    return np.array([i for i, _ in contacts if tuple(map(int, data.contact.geom[i])) in near])


def _by_pad(contacts: list[tuple[int, int]]) -> list[np.ndarray]:
    pads = {pad for _, pad in contacts}
    return [np.array([i for i, on in contacts if on == pad]) for pad in sorted(pads)]


def _tips(data: Any, contacts: list[tuple[int, int]]) -> np.ndarray:
    kept = []
    for rows in _by_pad(contacts):
        points = data.contact.pos[rows]
        # The direction of the largest spread is along the wire.
        along = np.linalg.svd(points - points.mean(0), full_matrices=False)[2][0]
        place = points @ along
        kept += [rows[place.argmin()], rows[place.argmax()]]
    return np.unique(kept)


def _ends(data: Any, contacts: list[tuple[int, int]]) -> np.ndarray:
    deepest = [rows[data.contact.dist[rows].argmin()] for rows in _by_pad(contacts)]
    return np.unique([*_tips(data, contacts), *deepest])


def _moments(data: Any, contacts: list[tuple[int, int]]) -> dict[int, Point]:
    kept: dict[int, Point] = {}
    for rows in _by_pad(contacts):
        points, dist = data.contact.pos[rows], data.contact.dist[rows]
        if len(rows) <= POINTS:
            kept |= {int(i): Point(p, d, 1.0) for i, p, d in zip(rows, points.copy(), dist.copy())}
            continue
        middle = points.mean(0)
        _, spread, axes = np.linalg.svd(points - middle, full_matrices=False)
        # Depth as an affine function of the place in the face: same sums and first moments.
        inside = np.column_stack([np.ones(len(rows)), (points - middle) @ axes[:2].T])
        depth, *_ = np.linalg.lstsq(inside, dist, rcond=None)
        sigma = spread[:2] * np.sqrt(2.0 / len(rows))  # set of four points: two along each axis
        for k, (x, y) in enumerate(((1, 0), (-1, 0), (0, 1), (0, -1))):
            place = np.array([x * sigma[0], y * sigma[1]])
            at = float(depth @ [1.0, *place])
            kept[int(rows[k])] = Point(middle + place @ axes[:2], at, len(rows) / POINTS)
    return kept


KEEPS: dict[str, Keep] = {"nearest": _nearest, "ends": _ends, "tips": _tips, "moments": _moments}


if __name__ == "__main__":
    main()
