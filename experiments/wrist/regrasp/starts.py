"""Starts of needle regrasp that one arm can take square, in closed form, at every trocar.

    python experiments/wrist/regrasp/starts.py [--starts 4000] [--sampled 500] [--tiny]

Starts are drawn as the task draws them, at any yaw and up to 30 degrees of tilt, as many at every
trocar. One arm can take a start if the expert's grasp is square and the wrist within its limits,
palm and shaft clear of the plate. No simulation, no time.
"""

import argparse
import pathlib
import sys
import types
from typing import Any

sys.path.append(str(pathlib.Path(__file__).parents[3] / "benchmarks"))
import _timing
import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm, runtime
from starjax.addons.suture.needle_regrasp import expert, task
from starjax.sim import registries, sampling, scene
from starjax.tasks.wrist_script import WRIST

SEED, ARM = 2026, "psm"
TOOL = registries.tools.get("needle_driver")


def main() -> None:
    runtime.prepare_xla()
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--starts", type=int, default=4000, help="at each trocar")
    parser.add_argument("--sampled", type=int, default=500, help="trocars drawn from Eq. 19")
    parser.add_argument("--tiny", action="store_true", help="a test's sizes, nothing is written")
    asked = parser.parse_args()
    bound = task.bind(scene.compose(scene.name("needle_regrasp", (ARM,))))
    key = jax.random.key(SEED)
    drawn = sampling.sample_trocars(key, task.TASK, (asked.sampled,))
    rows = {
        name: row(bound, trocars, jax.random.fold_in(key, i), asked.starts)
        for i, (name, trocars) in enumerate({"twelve": task.TASK.trocars, "eq19": drawn}.items())
    }
    _timing.report("regrasp", {"seed": SEED, "arm": ARM, "results": rows}, asked.tiny)


def row(bound: task.RegraspBound, trocars: rcm.Trocar, key: jax.Array, starts: int) -> Any:
    """Returns counts and the worst figures over all starts at trocars `[N, 1]`."""
    ref = np.array([slot.p_world_ref for slot in task.TASK.slots], np.float32)
    zero = np.array([slot.roll_zero for slot in task.TASK.slots], np.float32)

    @jax.jit
    def at(trocar: rcm.Trocar, key: jax.Array) -> Any:
        frame = rcm.trocar_frame(trocar, ref, zero)
        keys = jax.random.split(key, starts)
        return jax.vmap(lambda key: grasp(frame, task.sample(bound, key)))(keys)

    rows = range(len(trocars.radius))
    found = [
        at(jax.tree.map(lambda x, i=i: jnp.asarray(x)[i], trocars), jax.random.fold_in(key, i))
        for i in rows
    ]
    is_taken, angles, above, tilt = (np.stack(x) for x in zip(*found))
    figures = {
        "trocars": len(rows),
        "starts": is_taken.size,
        "not_taken": int((~is_taken).sum()),
        "largest_wrist_deg": float(np.rad2deg(angles.max())),
        "least_above_plate_mm": 1e3 * float(above.min()),
        "largest_tilt_deg": float(np.rad2deg(tilt.max())),
    }
    print(figures, flush=True)
    return figures


def grasp(frame: rcm.TrocarFrame, layout: task.RegraspLayout) -> tuple[jax.Array, ...]:
    """Returns True if a start can be taken, the wrist's larger angle (rad), m above the plate of
    palm or shaft, and the plate's tilt (rad)."""
    assert TOOL.wrist is not None
    measurements = types.SimpleNamespace(pick=types.SimpleNamespace(needle=layout.needle))
    state: Any = types.SimpleNamespace(measured_trocar=frame, measurements=measurements)
    tip = expert._grasp(state)
    found = rcm.through(WRIST, tip, frame.p_world_trocar[0])
    normal = layout.needle.R[:, 2]
    palm = tip.p - TOOL.wrist.jaws * tip.R[:, 2]
    shaft = rcm.shaft_of(WRIST, tip, found.wrist).p
    # The needle lies on the plate.
    above = jnp.stack([(p - layout.needle.p) @ normal for p in (palm, shaft)])
    above -= jnp.array([TOOL.palm_radius, TOOL.shaft_radius])
    is_taken = found.is_feasible & (above > 0).all()
    return is_taken, jnp.abs(found.wrist).max(), above.min(), jnp.arccos(normal[2])


if __name__ == "__main__":
    main()
