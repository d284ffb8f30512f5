"""Success on ring on wire by the place of the ring's start, and failures far from the ring.

python benchmarks/ring_starts.py RUN...

RUN is a directory of `starjax evaluate` with `--eval.video-trials` for all trials. Its name is that
of its row in results/ring_starts_cpu.json.
"""

import sys
from pathlib import Path
from typing import Any

import _timing
import numpy as np

from starjax.report import outcomes, results
from starjax.sim import scene

EDGE = 0.039  # m from the wire's middle; rings start 33.5 to 40.5 mm from it
FAR = 0.03  # m from the ring to the tip at the end of a trial


def main() -> None:
    """Writes the counts of every run."""
    rows = {Path(run).name: counts(results.load(Path(run))) for run in sys.argv[1:]}
    print(f"wrote {_timing.write('ring_starts', {'edge_m': EDGE, 'far_m': FAR, 'results': rows})}")


def counts(run: results.Run) -> dict[str, Any]:
    """Returns successes and trials by start, failures, and those that end far from the ring."""
    ring = scene.load(run.result.scene).bound.ring  # first index of its coordinates
    qpos = [x.qpos for x in run.rollouts if x.qpos is not None]
    starts = np.array([abs(x[0, ring + 1]) for x in qpos])
    won = np.array([outcomes.strict(x.trial) for x in run.rollouts])
    tips = [x.p_world_tip[-1, 0] for x in run.rollouts]
    ends = [x[-1, ring : ring + 3] - tip for x, tip in zip(qpos, tips, strict=True)]
    far = np.linalg.norm(ends, axis=-1) > FAR
    return {
        "within": _counted(won[starts <= EDGE]),
        "beyond": _counted(won[starts > EDGE]),
        "failures": int((~won).sum()),
        "far": int((far & ~won).sum()),
    }


def _counted(won: np.ndarray) -> dict[str, int]:
    return {"successes": int(won.sum()), "trials": len(won)}


if __name__ == "__main__":
    main()
