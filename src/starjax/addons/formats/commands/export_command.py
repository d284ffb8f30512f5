"""`starjax export`: writes demonstrations in the format of another library."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from starjax.cli import checks, options
from starjax.core import errors
from starjax.core.config import Range
from starjax.runtime import files, hub, progress, xla

DESCRIPTION = """Exports demonstrations in another format, from which they can be restored exactly.

DATASET is a directory of demonstrations such as runs/cpu/demos-0123456789ab, OUT the new file or
directory.

Examples:
  starjax export runs/cpu/demos-0123456789ab out/lerobot
  starjax export runs/cpu/demos-0123456789ab out/demos.hdf5 --format robomimic"""


@dataclasses.dataclass(frozen=True)
class ExportArgs:
    """Flags of the command."""

    dataset: Annotated[
        str, tyro.conf.Positional, tyro.conf.arg(metavar="DATASET")
    ]  # directory of demonstrations
    # new file or directory
    out: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    # lerobot (LeRobotDataset v3.0), lerobot-v2.1, robomimic (HDF5) or zarr
    format: str = "lerobot"
    # image size, pixels per side, for a dataset without recorded images; 0: no images
    image_size: Annotated[int, Range(0, 4_096)] = 256
    state_with_trocar: bool = False  # append the trocar to the state, for readers of it alone
    actions: str = "pose"  # pose (8 numbers per arm), or rcm4: roll, tip and gripper
    video: bool = True  # lerobot: store images as lossy video, else as PNG


def main(argv: Sequence[str]) -> int:
    """Writes the export; prints its size."""
    args = options.parse("export", ExportArgs, argv, DESCRIPTION)
    out = Path(args.out)
    checks.expect(bool(args.out) and not out.exists(), "OUT", "a new file or directory", args.out)
    checks.expect_folder("folder of OUT", out.parent)
    xla.prepare_xla()
    from starjax.addons.formats import base, exchange, peer_columns
    from starjax.data import pose_rows

    errors.choice("format", args.format, base.writable())
    errors.choice("actions", args.actions, pose_rows.ACTIONS)
    columns = peer_columns.PeerOptions(args.state_with_trocar, args.actions)
    form, root = base.FORMATS.get(args.format), hub.dataset("DATASET", args.dataset)
    try:
        source = exchange.source(root, form, args.image_size, columns)
    except ValueError as error:
        raise errors.UsageError("DATASET", "demonstrations that are complete", error) from error
    with progress.track("Export", len(source.lengths), unit="episodes") as advance:
        exchange.export(source, out, form, args.video, advance)
    inside = [out] if out.is_file() else [path for path in out.rglob("*") if path.is_file()]
    size = files.size(sum(path.stat().st_size for path in inside))
    counts = f"{len(source.lengths)} episodes, {sum(source.lengths)} frames"
    print(f"{out}: {form.description}, {counts}, {size}")
    return 0
