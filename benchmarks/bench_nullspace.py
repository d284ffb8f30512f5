"""How far the joints of seven-joint arms drift over five laps of a closed path, and no time.

    python benchmarks/bench_nullspace.py

Inverse kinematics alone, as the simulated arm has it in each control step (four iterations from the
step before), from the paper's twelve trocars: the tip goes around a circle on the RCM manifold and
the roll to and fro. The first lap settles; then every lap should end as the one before. The peer is
the same without the null-space term.
"""

import _timing
import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm, runtime
from starjax.sim import arm_motion, ik, mounts, registries

LAPS, STEPS = 5, 90  # control steps a lap
RADIUS, HEIGHT, SWAY = 0.025, 0.025, 0.5  # m, m, rad
ARMS = ("panda", "iiwa14")
TOOL, WORKSPACE = "grasper", "board"


def main() -> None:
    runtime.prepare_xla()
    rows = {}
    for name in ARMS:
        gain = registries.arms.get(name).rest_gain
        (drift, residual), (without, _) = laps(name, gain), laps(name, 0.0)
        rows[name] = {"gain": gain, "drift_rad": drift, "drift_rad_without": without}
        rows[name]["residual_m"] = residual
        print(f"{name}: {drift:.2g} rad with gain {gain:g}, {without:.2g} without")
    _timing.report("nullspace", {"laps": LAPS, "results": rows}, tiny=False)


def laps(name: str, gain: float) -> tuple[float, float]:
    """Drift (rad) of the arm's joints at the ends of laps, and the largest residual (m)."""
    arm, workspace = registries.arms.get(name), registries.workspaces.get(WORKSPACE)
    at, mount = mounts.bench(arm, registries.tools.get(TOOL)), arm.mounts[TOOL, WORKSPACE]
    place = jnp.array([*mount.position, mount.yaw, mount.turn, mount.tilt], jnp.float32)
    chain, home = mounts.standing(at.flange, at.tip, place), jnp.asarray(mount.home, jnp.float32)
    trocars = mounts.frame_of(jax.tree.map(jnp.asarray, rcm.TROCARS), workspace)
    turn = 2.0 * np.pi * np.arange(1, STEPS + 1) / STEPS
    roll, height = np.mean(workspace.rolls) + SWAY * np.sin(turn), np.full(STEPS, HEIGHT)
    lap = np.stack([roll, RADIUS * np.cos(turn), RADIUS * np.sin(turn), height], -1)
    path = jnp.asarray(np.tile(lap, (LAPS + 1, 1)), jnp.float32)

    def one(trocar: rcm.TrocarFrame) -> tuple[jax.Array, jax.Array]:
        def step(q: jax.Array, action: jax.Array) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
            pose, _ = rcm.ACTION_SPACES["rcm4"].decode(action, trocar)
            q, residual = ik.solve(chain, pose, q, arm_motion.STEP_IK_ITERATIONS, home, gain)
            return q, (q, residual)

        pose, _ = rcm.ACTION_SPACES["rcm4"].decode(path[-1], trocar)
        first, _ = ik.solve(chain, pose, home, mounts.ITERATIONS, home, gain)
        return jax.lax.scan(step, first, path)[1]

    with jax.default_matmul_precision("highest"):
        q, residual = jax.jit(jax.vmap(one))(trocars)
    ends = q[:, STEPS - 1 :: STEPS]
    return float(jnp.max(jnp.abs(ends - ends[:, :1]))), float(jnp.max(residual))


if __name__ == "__main__":
    main()
