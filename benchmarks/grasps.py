"""How recorded trials first close their jaws: turned off the block's wall, and how far from it.

    python benchmarks/grasps.py RUN...

RUN is a method's folder, of an evaluation that recorded trials (`--eval.video-trials`). Jaws close
along their y axis, wanted on a wall's normal; the tip is wanted `RIM_RADIUS` from the block's axis.
"""

import argparse
import pathlib

import mujoco
import numpy as np

from starjax.experiments.report import results
from starjax.sim import env as envs
from starjax.sim.tasks import peg_transfer as task

PERIOD_DEG = 60.0  # walls are 120 degrees apart, and jaws look alike after half a turn
TURNED_DEG = 10.0
JAW = "robot/tool/jaw_left"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="+", type=pathlib.Path)
    model = envs.make("state").model.mj_model
    print("run: trials; of the successful ones angle off the wall, mean and deviation (deg);")
    print("successful of those within 1 mm of the wall, of the others;")
    print(f"of those within {TURNED_DEG:g} degrees of it, of the others")
    for path in parser.parse_args().runs:
        run = results.load(path)
        found = [first_closing(model, it) for it in run.rollouts]
        success = np.array([bool(it.trial["success"]) for it in run.rollouts])
        angle, radius = np.array(found).T
        near = np.abs(radius - task.RIM_RADIUS) < 0.001
        turned = np.abs(angle) < TURNED_DEG
        counts = [f"{success[w].sum()} of {w.sum()}" for w in (near, ~near, turned, ~turned)]
        won = angle[success]
        spread = f"{np.nanmean(won):.1f}, {np.nanstd(won):.1f}"
        print(f"{path}: {len(found)}; {spread}; {'; '.join(counts)}")


def first_closing(model: mujoco.MjModel, it: results.Rollout) -> tuple[float, float]:
    """Angle (deg, within half a period) and distance of the tip from the block's axis (m) when the
    jaws first are half closed; NaN if they never are."""
    assert it.qpos is not None
    jaw = it.qpos[:, model.joint(JAW).qposadr[0]]
    closed = np.abs(jaw - jaw[0]) > 0.5 * np.ptp(jaw)
    if not closed.any():
        return np.nan, np.nan
    data = mujoco.MjData(model)
    data.qpos[:] = it.qpos[closed.argmax()]
    mujoco.mj_kinematics(model, data)
    tip, block = data.site("robot/tool/tcp"), data.body("block")
    in_block = block.xmat.reshape(3, 3).T @ tip.xmat.reshape(3, 3)[:, 1]
    angle = np.degrees(np.arctan2(in_block[1], in_block[0]))
    place = block.xmat.reshape(3, 3).T @ (tip.xpos - block.xpos)
    half = PERIOD_DEG / 2
    return (angle + half) % PERIOD_DEG - half, float(np.hypot(*place[:2]))


if __name__ == "__main__":
    main()
