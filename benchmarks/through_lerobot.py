"""No time: demonstrations that went through LeRobot's format and lost the trocar.

    python benchmarks/through_lerobot.py DATASET OUT

They are exported, all that only we write and all that says a trocar is removed from the files, and
the rest is imported by a mapping, with trocars estimated from the motion. OUT gets `lerobot`,
`map.toml` and `imported`, which trains as the dataset itself: this is how far it is from it.
"""

import argparse
import functools
import itertools
import pathlib
from typing import Any

import _timing
import numpy as np
import pyarrow.parquet as parquet

from starjax import runtime
from starjax.addons.formats import base, exchange, foreign, mapping
from starjax.data import load, store
from starjax.runtime import files

MAP = """task = "peg_transfer"

[[arms]]
position = "observation.state[0:3]"
rotation = "observation.state[3:7]"
rotation_as = "quat_xyzw"
gripper = "observation.state[7]"
command_position = "action[0:3]"
command_rotation = "action[3:7]"
command_gripper = "action[7]"

[cameras.camera]
column = "observation.images.camera"
"""
OURS = ("README.md", "meta/starjax.json")
EVERY = 10  # images that are compared
QUIET: Any = {"images": False, "residency": "host", "report": lambda _: None}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dataset", type=pathlib.Path)
    parser.add_argument("out", type=pathlib.Path)
    asked = parser.parse_args()
    runtime.prepare_xla()
    form, folder = base.FORMATS.get("lerobot"), asked.out / "lerobot"
    exchange.export(exchange.source(asked.dataset, form), folder, form)
    strip(folder)
    (asked.out / "map.toml").write_text(MAP)
    with base.open_dataset(folder, "lerobot") as source:
        assert source.origin is None and not any(map(is_ours, source.columns))
        given = mapping.load(asked.out / "map.toml")
        found = foreign.import_mapped(source, given, asked.out / "imported", asked.out)
    row = {
        "digest": store.read_seal(asked.dataset)["digest"],
        "imported": found.digest,
        "episodes": found.episodes,
        "left_out": found.left_out,
        "frames": found.frames,
        "notes": len(found.notes),
        "residual_mm": float(found.residual_mm.max()),
        **compared(asked.dataset, asked.out / "imported"),
    }
    print(row)
    print(f"wrote {_timing.write('through_lerobot', {'results': {'video': row}})}")


def is_ours(name: str) -> bool:
    """Whether a column or a statistic is one that others would not have."""
    return "starjax." in name or "observation.trocar" in name


def strip(folder: pathlib.Path) -> None:
    """Removes our own columns and the trocar from an export."""
    for name in OURS:
        (folder / name).unlink()
    for path in [*folder.rglob("data/*/*.parquet"), *folder.rglob("meta/episodes/*/*.parquet")]:
        without(path)
    info, stats = folder / "meta/info.json", folder / "meta/stats.json"
    said = files.read_json(info)
    files.write_json(info, said | {"features": kept(said["features"])})
    files.write_json(stats, kept(files.read_json(stats)))


def kept(said: dict) -> dict:
    return {name: value for name, value in said.items() if not is_ours(name)}


def without(path: pathlib.Path) -> None:
    """A file of numbers without our columns: an episode stays a group of rows."""
    before = parquet.ParquetFile(path)
    names = [name for name in before.schema_arrow.names if not is_ours(name)]
    made = path.with_suffix(".new")
    groups = (before.read_row_group(i, names) for i in range(before.num_row_groups))
    plain = (group.replace_schema_metadata(None) for group in groups)
    first = next(plain)
    with parquet.ParquetWriter(made, first.schema) as writer:
        for table in itertools.chain([first], plain):
            writer.write_table(table)
    made.rename(path)


def compared(original: pathlib.Path, imported: pathlib.Path) -> dict[str, float]:
    """How far one dataset is from the other, episode by episode."""
    one, other = (load.load(path, **QUIET).dataset for path in (original, imported))
    np.testing.assert_array_equal(one.start, other.start)
    off = places(original) - places(imported)
    off_mm = 1e3 * np.linalg.norm(off[:, 0], axis=-1)
    far = functools.partial(farthest, one, other)
    images = [load.frames(path)["camera"] for path in (original, imported)]
    some = np.arange(0, len(one.episode), EVERY)
    a, b = (frames[some].astype(np.float32) for frames in images)
    return {
        "trocar_mm_max": float(off_mm.max()),
        "trocar_mm_mean": float(off_mm.mean()),
        "tip_mm": 1e3 * far(lambda x: x.observation.pose.p),
        "command_mm": 1e3 * far(lambda x: x.command.pose.p),
        "rotation": far(lambda x: x.observation.pose.R),
        "command_rotation": far(lambda x: x.command.pose.R),
        "jaws": far(lambda x: x.observation.gripper),
        "command_jaws": far(lambda x: x.command.gripper),
        "psnr_db": float(10 * np.log10(255**2 / max(np.mean((a - b) ** 2), 1e-9))),
        "darker": float((a - b).mean()),
    }


def places(root: pathlib.Path) -> np.ndarray:
    """Trocars `[E, A, 3]` m of the episodes that are learned from."""
    return np.asarray(load.load(root, **QUIET).dataset.trocar.p_world_trocar, np.float64)


def farthest(one, other, pick) -> float:
    return float(np.abs(np.asarray(pick(one)) - np.asarray(pick(other))).max())


if __name__ == "__main__":
    main()
