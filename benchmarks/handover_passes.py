"""Distance of the second tool from the needle when it closes, on needle hand-over.

python benchmarks/handover_passes.py RUN...

RUN is a directory of `starjax evaluate` or a report of `starjax finetune`, with recorded trials.
Its name is that of its row in results/handover_passes_cpu.json.
"""

import sys
from pathlib import Path
from typing import Any

import _timing
import numpy as np

from starjax.report import outcomes, results
from starjax.sim import bodies, scene
from starjax.tasks.needle_pick import task as needle

TAKER = 1  # index of its arm
CLOSES = 0.6  # fraction of the jaws' largest opening in a trial
LIFTED = 2  # stage of a needle that the first tool holds in the air


def main() -> None:
    """Writes the medians of every run."""
    rows = {Path(run).name: medians(results.load(Path(run))) for run in sys.argv[1:]}
    print(f"wrote {_timing.write('handover_passes', {'results': rows})}")


def medians(run: results.Run) -> dict[str, Any]:
    """Returns trials and median distance (mm) of successes and of drops in the pass."""
    loaded = scene.load(run.result.scene)
    found = [(x.trial, distance(loaded, x)) for x in run.rollouts]
    won = [mm for trial, mm in found if outcomes.strict(trial)]
    dropped = [mm for trial, mm in found if trial.lost and trial.stage == LIFTED]
    return {"successes": _median(won), "drops": _median(dropped), "trials": len(found)}


def distance(loaded: scene.Scene, trajectory: results.TrialTrajectory) -> float:
    """Returns the distance (mm) from the tip to the wire at the first closing; NaN without one."""
    assert trajectory.qpos is not None
    qpos, first = trajectory.qpos, loaded.bound.needle
    opening = qpos[:, loaded.arms[TAKER].jaws[0]]
    is_open = opening >= CLOSES * opening.max()
    is_up = qpos[1:, first + 2] > loaded.bound.height + needle.LIFT
    steps = np.flatnonzero(is_open[:-1] & ~is_open[1:] & is_up) + 1
    if not len(steps):
        return np.nan
    pose = bodies.free_pose(qpos[steps[0]], first)
    wire = np.asarray(pose.p + needle.segments()[0] @ pose.R.T)
    away = np.linalg.norm(wire - trajectory.p_world_tip[steps[0], TAKER], axis=-1)
    return 1e3 * float(away.min())


def _median(distances: list[float]) -> dict[str, Any]:
    known = [mm for mm in distances if np.isfinite(mm)]
    return {"trials": len(known), "mm": float(np.median(known)) if known else None}


if __name__ == "__main__":
    main()
