"""Demonstrations of others in memory: smooth motions through trocars, in ordinary columns."""

import numpy as np
from scipy.spatial import transform

from starjax import rcm
from starjax.addons.formats import foreign
from starjax.addons.formats.base import Column, Source
from starjax.addons.formats.mapping import ArmColumns, Map

P_WORLD_REF = np.array([0.0, 0.0, 0.15])
RNG = np.random.default_rng(0)
# What a peer's files say of the world and of the tool: their frames in ours.
TURN = transform.Rotation.from_rotvec([0.3, -0.2, 1.0])
TIP_TURN = transform.Rotation.from_euler("y", np.pi / 2)
ORIGIN, TIP = np.array([0.3, -0.1, 0.05]), np.array([0.01, 0.0, -0.02])


def wxyz(rotation):
    return tuple(np.roll(rotation.as_quat(), 1).tolist())


def moved(times, trocar, seed):
    """Smooth poses through a trocar: R, p, jaws."""
    phase = 3.0 * seed
    tips = np.stack(
        [
            0.03 * np.sin(1.1 * times + phase),
            0.03 * np.cos(0.7 * times + phase),
            0.02 + 0.01 * np.sin(0.5 * times),
        ],
        -1,
    )
    R = rcm.rotation_from_axis_roll((tips - trocar).astype(np.float32), 0.8 * times + phase)
    R = transform.Rotation.from_matrix(np.asarray(R, np.float64)).as_matrix()
    return R, tips, np.sin(times)


TROCARS = P_WORLD_REF + np.array([[0.03, 0.01, 0.01], [-0.02, 0.03, -0.01]])
SECONDS = 4.0


def source(times=None, change=None, hz=30.0, images=False, arms=1):
    """Three episodes in ordinary columns; the first two have one trocar."""
    times = np.arange(int(SECONDS * hz)) / hz if times is None else times
    found = []
    for episode in range(3):
        arrays = {"time": times, "state": np.tile(np.arange(12.0), (len(times), 1))}
        for arm in range(arms):
            R, p, jaws = moved(times, TROCARS[(episode // 2 + arm) % 2], episode + arm)
            arrays |= {f"R{arm}": R, f"p{arm}": p, f"jaws{arm}": jaws}
        if images:
            arrays["image"] = RNG.integers(0, 255, (len(times), 12, 16, 3), np.uint8)
        found.append(change(arrays) if change else arrays)
    columns = {name: Column(x.shape[1:], x.dtype.name) for name, x in found[0].items()}
    lengths = [len(arrays["time"]) for arrays in found]
    return Source(hz, lengths, columns, lambda i, names: {n: found[i][n] for n in names})


ARM = ArmColumns(position="p0", rotation="R0", rotation_as="matrix", gripper="jaws0")
MAP = Map(task="peg_transfer", state="state", arms=(ARM,))


def bring(tmp_path, given=None, made=MAP, name="d"):
    return foreign.import_mapped(given or source(), made, tmp_path / name, tmp_path)
