"""`starjax export DATASET OUT`: demonstrations of ours in a format that others read."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from starjax import errors
from starjax.commands import checks, options
from starjax.runtime import files, progress, xla

DESCRIPTION = """Writes demonstrations in another format, with all that brings them back whole.

DATASET is a folder of demonstrations such as runs/cpu/demos-0123456789ab, OUT the file or folder to
write."""


@dataclasses.dataclass(frozen=True)
class ExportArgs:
    """Flags of the command."""

    dataset: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="DATASET")]  # a folder
    out: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]  # what to write
    format: str = "lerobot"  # lerobot (LeRobotDataset v3.0), robomimic (HDF5) or zarr
    video: bool = True  # of lerobot: images as video, which loses a little; else as PNG


def main(argv: Sequence[str]) -> int:
    """Writes the export, says how large it is."""
    args = options.parse("export", ExportArgs, argv, DESCRIPTION)
    out = Path(args.out)
    checks.expect(bool(args.out) and not out.exists(), "OUT", "a place not taken", args.out)
    checks.expect_folder("folder of OUT", out.parent)
    xla.prepare_xla()
    from starjax.data.formats import base, exchange

    errors.choice("format", args.format, base.FORMATS.names())
    form, root = base.FORMATS.get(args.format), Path(args.dataset)
    try:
        found = exchange.source(root, form)
    except ValueError as error:
        raise errors.UsageError("DATASET", "demonstrations that are complete", error) from error
    with progress.track("Export", len(found.lengths), unit="episodes") as advance:
        exchange.export(found, out, form, args.video, advance)
    inside = [out] if out.is_file() else [path for path in out.rglob("*") if path.is_file()]
    size = files.size(sum(path.stat().st_size for path in inside))
    counts = f"{len(found.lengths)} episodes, {sum(found.lengths)} frames"
    print(f"{out}: {form.description}, {counts}, {size}")
    return 0
