"""Reach of arms with wristed tools, and the executed error of their shafts along a needle's arc.

    python experiments/wrist/reach.py [--only fr5/needle_driver ...]

Reach: fraction of tip poses over the board that inverse kinematics reaches among those that the
wrist allows, for axes of the jaws within a tilt of straight down, any yaw, at the paper's twelve
trocars; jaws may be half a turn on. Arc: the tip of a tool that drives a needle (SH) by 121 degrees
in 4 s through each trocar, in C MuJoCo with the environment's own controller. No peer, no time.
"""

import argparse
import itertools
import pathlib
import sys
from typing import Any

sys.path.append(str(pathlib.Path(__file__).parents[2] / "benchmarks"))
import _c_env
import _timing
import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm, runtime
from starjax.core.types import Command, Pose
from starjax.sim import env as envs
from starjax.sim import ik, mounts, registries
from starjax.sim.env import Env
from starjax.sim.task import CONTROL_HZ
from starjax.tasks import scripting

TOOLS = ("needle_driver", "prograsp")
WORKSPACE = registries.workspaces.get("board")
TILTS = (0.0, 30.0, 60.0)  # degrees
POSES = 100  # per trocar and tilt
ITERATIONS = 60
HALF_TURN = np.diag([-1.0, -1.0, 1.0]).astype(np.float32)
# The arc: a needle held 135 degrees behind its point, its centre 0.7 radii above the surface. The
# point begins 10 degrees before it enters and ends 20 degrees after it left.
RADIUS, HELD, SHARE = 0.0083, np.deg2rad(135.0), 0.7
SWEEP = np.array([-1.0, 1.0]) * np.arccos(SHARE) + np.deg2rad([-10.0, 20.0])
LEAD, SECONDS, REST = 2.0, 4.0, 0.5
GRASPS = np.deg2rad(list(itertools.product(range(0, 360, 15), range(-45, 46, 15))))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--only", nargs="*", default=[], help="rows, as fr5/needle_driver")
    only = parser.parse_args().only
    runtime.prepare_xla()
    rows = {}
    for arm, tool in itertools.product(registries.arms.names(), TOOLS):
        name = f"{arm}/{tool}"
        if not only or name in only:
            row = rows[f"{arm} {tool}"] = reach(arm, tool) | arc(arm, tool)
            print(name, row, flush=True)
    sizes = {
        "poses": POSES,
        "trocars": 12,
        "tilts_deg": TILTS,
        "turn_deg": np.rad2deg(np.ptp(SWEEP)),
    }
    _timing.report("wrist", {**sizes, "results": rows}, tiny=False)


def trocars() -> rcm.TrocarFrame:
    """The paper's twelve, fields `[12]`."""
    return mounts.frame_of(jax.tree.map(jnp.asarray, rcm.TROCARS), WORKSPACE)


def reach(arm_name: str, tool_name: str) -> dict[str, Any]:
    """Fractions of poses that are reached, all and at the worst trocar, by tilt."""
    arm, tool = registries.arms.get(arm_name), registries.tools.get(tool_name)
    wrist, mount = tool.wrist, arm.mounts[tool_name, "board"]
    assert wrist is not None
    at = mounts.bench(arm, tool)
    place = jnp.array([*mount.position, mount.yaw, mount.turn, mount.tilt], jnp.float32)
    chain, home = mounts.standing(at.flange, at.tip, place), jnp.asarray(mount.home, jnp.float32)

    @jax.jit
    @jax.vmap
    def one(R: jax.Array, p: jax.Array, o: jax.Array) -> tuple[jax.Array, jax.Array]:
        there = chain.replace(p_base=chain.p_base + o) if arm.remote_centre else chain
        reached = []
        for half in (np.eye(3, dtype=np.float32), HALF_TURN):
            found = rcm.through(wrist, Pose(R @ half, p), o)
            shaft = rcm.shaft_of(wrist, found.pose, found.wrist)
            _, residual = ik.solve(there, shaft, home, ITERATIONS, home, arm.rest_gain)
            reached.append(residual < mounts.REACHED)
        return found.is_feasible, reached[0] | reached[1]

    rng, out = np.random.default_rng(0), {}
    o = np.repeat(np.asarray(trocars().p_world_trocar), POSES, axis=0)
    p = rng.uniform(WORKSPACE.low, WORKSPACE.high, (len(o), 3)).astype(np.float32)
    for tilt in TILTS:
        lean = np.arccos(1.0 - rng.uniform(0, 1 - np.cos(np.deg2rad(tilt)), len(o)))
        azimuth, yaw = rng.uniform(-np.pi, np.pi, (2, len(o)))
        side = np.sin(lean)
        axis = np.stack([side * np.cos(azimuth), side * np.sin(azimuth), -np.cos(lean)], -1)
        R = rcm.rotation_from_axis_roll(axis.astype(np.float32), yaw.astype(np.float32))
        with jax.default_matmul_precision("highest"):
            allowed, reached = map(np.asarray, one(R, p, o))
        by_trocar = [
            reached[i : i + POSES][allowed[i : i + POSES]].mean() for i in range(0, len(o), POSES)
        ]
        out[f"{tilt:.0f}"] = {
            "within_wrist": float(allowed.mean()),
            "reached": float(reached[allowed].mean()),
            "worst_trocar": float(min(by_trocar)),
        }
    return {"tilt": out}


def turning(theta: Any, grasp: Any) -> Pose:
    """The tip's pose with the needle's point at `theta` rad, for a grasp (about the wire, lean)."""
    about, lean = grasp
    along, normal = jnp.array([1.0, 0.0, 0.0]), jnp.array([0.0, 1.0, 0.0])
    up, angle = jnp.array([0.0, 0.0, 1.0]), theta - HELD
    out = jnp.sin(angle) * along - jnp.cos(angle) * up
    tangent = jnp.cos(angle) * along + jnp.sin(angle) * up
    z = jnp.cos(about) * normal - jnp.sin(about) * out
    z, x = jnp.cos(lean) * z + jnp.sin(lean) * tangent, jnp.cos(lean) * tangent - jnp.sin(lean) * z
    return Pose(jnp.stack([x, jnp.cross(z, x), z], -1), RADIUS * (SHARE * up + out))


def path() -> np.ndarray:
    """The point's angle `[T]` rad at each control step: at rest, the arc, at rest."""
    steps = np.arange(round((LEAD + SECONDS + REST) * CONTROL_HZ)) / CONTROL_HZ
    fraction = scripting.sloped(np.clip((steps - LEAD) / SECONDS, 0.0, 1.0))
    return np.asarray(SWEEP[0] + fraction * np.ptp(SWEEP), np.float32)


def arc(arm: str, tool: str) -> dict[str, Any]:
    """Executed distances (mm) of the shaft from the trocar and of the tip from its path."""
    env = _c_env.with_c_physics(envs.make("reach", [arm], [tool], observation="state"))
    follow = jax.jit(lambda theta, grasp, half, trocar: _follow(env, theta, grasp, half, trocar))
    theta, shaft, tip, angle = path(), [], [], []
    for k in range(len(rcm.TROCARS.radius)):
        trocar = jax.tree.map(lambda x, k=k: jnp.asarray(x[k : k + 1], jnp.float32), rcm.TROCARS)
        wrist = registries.tools.get(tool).wrist
        o = np.asarray(trocars().p_world_trocar)[k]
        grasp, largest = _easiest(wrist, theta, o)
        halves = [
            follow(theta, grasp, half, trocar) for half in (np.eye(3, dtype=np.float32), HALF_TURN)
        ]
        # The posture whose joints stay within their limits, chosen before it starts.
        best = min((jax.device_get(x) for x in halves), key=lambda x: x[2].max())
        moving = slice(round(LEAD * CONTROL_HZ), None)
        shaft.append(best[0][moving])
        tip.append(best[1][moving])
        angle.append(largest)
    shaft, tip = 1e3 * np.concatenate(shaft), 1e3 * np.concatenate(tip)
    return {
        "shaft_mm": {"p99": float(np.quantile(shaft, 0.99)), "max": float(shaft.max())},
        "tip_mm": {"p99": float(np.quantile(tip, 0.99)), "max": float(tip.max())},
        "wrist_deg": float(np.rad2deg(max(angle))),
    }


def _easiest(wrist: Any, theta: np.ndarray, o: np.ndarray) -> tuple[np.ndarray, float]:
    """The grasp that bends the wrist least along the arc at a trocar, and its largest angle."""
    some = theta[:: len(theta) // 20]

    def largest(grasp: jax.Array) -> jax.Array:
        pose = jax.vmap(turning, (0, None))(some, grasp)
        return jnp.max(jnp.abs(rcm.angles_through(wrist, pose, o)))

    bends = np.asarray(jax.jit(jax.vmap(largest))(GRASPS.astype(np.float32)))
    return GRASPS[bends.argmin()].astype(np.float32), float(bends.min())


def _follow(env: Env, theta: Any, grasp: Any, half: Any, trocar: rcm.Trocar) -> tuple[Any, ...]:
    """Executed errors `[T]` (m) of the shaft and the tip; residual (m) of inverse kinematics."""
    wrist = env.scene.arms[0].tool.wrist
    assert wrist is not None

    def step(state: Any, angle: jax.Array) -> tuple[Any, tuple[jax.Array, ...]]:
        pose = turning(angle, grasp)
        pose = Pose((pose.R @ half)[None], pose.p[None])
        angles = rcm.angles_through(wrist, pose, state.trocar.p_world_trocar)
        state = env.step(state, Command(pose, -jnp.ones(1), angles))
        away = jnp.linalg.norm(state.pose.p[0] - pose.p[0])
        return state, (state.rcm_error_within[0], away, state.ik_error[0])

    start = env.reset(jax.random.key(0), envs.EnvParams(trocar))
    return jax.lax.scan(step, start, theta)[1]


if __name__ == "__main__":
    main()
