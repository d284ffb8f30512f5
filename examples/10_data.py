"""Imports a recording of your own as demonstrations: columns of numbers and a mapping.

Here the recording is a tool that reaches a mark, written as zarr; any of the formats of
`starjax.addons.formats` works. The mapping names the columns, their units and their frames; the
trocar is estimated from the shafts. Needs the extra `formats`.
"""

import pathlib
import tempfile

import jax.numpy as jnp
import numpy as np

from starjax import cli, rcm, runtime

HZ, SECONDS, EPISODES = 50.0, 3.0, 4
P_WORLD_TROCAR = np.array([0.014, 0.014, 0.153], np.float32)  # m
MAPPING = """
task = "reach"
units = "mm"
hz = 50.0
state = "mark"

[[arms]]
position = "tip[0:3]"
rotation = "tip[3:12]"
rotation_as = "matrix"
gripper = "jaw"
gripper_closed = 0.0
gripper_open = 1.0
"""


def record(seed: int) -> dict[str, np.ndarray]:
    """Returns the columns of an episode: a smooth path of the tip through one trocar."""
    rng = np.random.default_rng(seed)
    ends = rng.uniform([-0.03, -0.03, 0.02], [0.03, 0.03, 0.06], (4, 3))
    way = np.linspace(0.0, len(ends) - 1.0, round(HZ * SECONDS))
    p = np.stack([np.interp(way, range(len(ends)), ends[:, i]) for i in range(3)], -1)
    axis = p - P_WORLD_TROCAR
    R = rcm.rotation_from_axis_roll(axis, jnp.asarray(0.3 * np.sin(way)))
    tip = np.concatenate([1e3 * p, np.asarray(R).reshape(len(p), 9)], -1)
    mark = np.tile(ends[-1], (len(p), 1)).astype(np.float32)  # m
    return {"tip": tip.astype(np.float32), "jaw": np.ones((len(p), 1), np.float32), "mark": mark}


def main() -> None:
    runtime.prepare_xla()  # before the first jax array, or physics on a CPU is slow
    from starjax.addons.formats import base

    episodes = [record(seed) for seed in range(EPISODES)]
    source = base.Source(
        hz=HZ,
        lengths=[len(one["jaw"]) for one in episodes],
        columns={k: base.Column(x.shape[1:], x.dtype.name) for k, x in episodes[0].items()},
        read=lambda episode, names: {name: episodes[episode][name] for name in names},
        task="reach a mark",
    )
    with tempfile.TemporaryDirectory() as folder:
        recording, out = pathlib.Path(folder, "recording"), pathlib.Path(folder, "demos")
        base.FORMATS.get("zarr").write(recording, source, False)
        (mapping := pathlib.Path(folder, "map.toml")).write_text(MAPPING)
        cli.dispatch(["import", str(recording), str(out), "--map", str(mapping), "--accept"])
        print("files:", ", ".join(sorted(path.name for path in out.iterdir())))


if __name__ == "__main__":
    main()
