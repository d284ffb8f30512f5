"""How recorded trials come down on the block's wall, and how they first close the jaws on it.

    python benchmarks/grasps.py RUN...

RUN is a method's folder, of an evaluation that recorded trials (`--eval.video-trials`). Jaws close
along their y axis, wanted on a wall's normal; the tip is wanted on the wall, `RIM_RADIUS` from the
block's axis. Coming down is measured before any touch, from the block as it stood first.
"""

import argparse
import pathlib
from collections.abc import Callable

import mujoco
import numpy as np

from starjax.report import results
from starjax.sim import registries, scene
from starjax.tasks.peg_transfer import task

PERIOD_DEG = 60.0  # walls are 120 degrees apart, and jaws look alike after half a turn
TURNED_DEG = 10.0
BESIDE = 0.001  # m
ABOVE = 0.0065  # m over the block's frame: coming down
AROUND = 0.014  # m from the block's axis
MIDDLE = 0.012  # m: blocks nearer than this to y = 0 are on the middle row
TOOL = registries.tools.get("grasper")
JAW = f"arm0/tool/{TOOL.jaw}"
TIP = scene.tcp(0, TOOL)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="+", type=pathlib.Path)
    model = scene.compose(scene.name())
    for path in parser.parse_args().runs:
        report(model, results.load(path))


def report(model: mujoco.MjModel, run: results.Run) -> None:
    success = np.array([bool(it.trial.success) for it in run.rollouts])
    print(f"{run.path}: {success.sum()} of {len(success)} recorded trials succeed")
    angle, radius, _ = measure(model, run, closes).T
    near, turned = np.abs(radius - task.RIM_RADIUS) < BESIDE, np.abs(angle) < TURNED_DEG
    won = angle[success]
    print(f"  closing, successful: {np.nanmean(won):.1f} degrees off the wall's normal,", end=" ")
    print(f"deviation {np.nanstd(won):.1f}")
    for chosen, what in ((near, f"{1e3 * BESIDE:g} mm"), (turned, f"{TURNED_DEG:g} degrees")):
        print(f"  closing within {what}: {count(success, chosen)}, else {count(success, ~chosen)}")
    _, radius, row = measure(model, run, comes_down).T
    for chosen, what in ((np.abs(row) < MIDDLE, "middle"), (np.abs(row) >= MIDDLE, "outer")):
        inward = 1e3 * (task.RIM_RADIUS - radius[chosen])
        print(f"  {what} rows: {count(success, chosen)};", end=" ")
        print(f"coming down {np.nanmean(inward):.1f} mm inside, deviation {np.nanstd(inward):.1f}")


def count(success: np.ndarray, chosen: np.ndarray) -> str:
    return f"{success[chosen].sum()} of {chosen.sum()}"


def measure(model: mujoco.MjModel, run: results.Run, moment: Callable[..., int]) -> np.ndarray:
    """`[R, 3]` at that moment of each trial: angle off the nearest normal (deg), distance of the
    tip from the block's axis (m), the block's y at first (m); NaN where the moment never comes."""
    rows = []
    for it in run.rollouts:
        assert it.qpos is not None
        data = mujoco.MjData(model)
        tip, block = data.site(TIP), data.body("block")
        place(model, data, it.qpos[0])
        first, step = (block.xpos.copy(), block.xmat.copy()), moment(model, data, it.qpos)
        if step < 0:
            rows.append((np.nan, np.nan, first[0][1]))
            continue
        place(model, data, it.qpos[step])
        xpos, xmat = (block.xpos, block.xmat) if moment is closes else first
        jaws = xmat.reshape(3, 3).T @ tip.xmat.reshape(3, 3)[:, 1]
        angle = np.degrees(np.arctan2(jaws[1], jaws[0])) + PERIOD_DEG / 2
        away = xmat.reshape(3, 3).T @ (tip.xpos - xpos)
        rows.append((angle % PERIOD_DEG - PERIOD_DEG / 2, np.hypot(*away[:2]), first[0][1]))
    return np.array(rows)


def closes(model: mujoco.MjModel, data: mujoco.MjData, qpos: np.ndarray) -> int:
    """The step at which the jaws first are half closed, or -1: they never were more than a quarter
    of their opening closed."""
    jaw = qpos[:, model.joint(JAW).qposadr[0]]
    closed = np.abs(jaw - jaw[0]) > 0.5 * np.ptp(jaw)
    return int(closed.argmax()) if np.ptp(jaw) > 0.25 * TOOL.open else -1


def comes_down(model: mujoco.MjModel, data: mujoco.MjData, qpos: np.ndarray) -> int:
    """The step at which the tip first is `ABOVE` the block, or -1."""
    block = data.body("block").xpos.copy()
    for step, now in enumerate(qpos):
        place(model, data, now)
        away = data.site(TIP).xpos - block
        if away[2] < ABOVE and np.hypot(*away[:2]) < AROUND:
            return step
    return -1


def place(model: mujoco.MjModel, data: mujoco.MjData, qpos: np.ndarray) -> None:
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)


if __name__ == "__main__":
    main()
