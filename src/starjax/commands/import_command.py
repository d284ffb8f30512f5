"""`starjax import`: restores exports, and imports other datasets by a mapping file."""

import dataclasses
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro

from starjax import errors
from starjax.commands import checks, messages, options
from starjax.runtime import progress, xla

_SHOWN = 10  # anomalies, the others are in a file
DESCRIPTION = """Imports demonstrations in another format as a dataset to train on.

PATH is a LeRobot or zarr directory or an HDF5 file, OUT the new dataset. An export of starjax is
restored exactly. For other datasets, a mapping file describes the columns."""


@dataclasses.dataclass(frozen=True)
class ImportArgs:
    """Flags of the command."""

    path: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="PATH")]  # dataset to import
    out: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]  # new dataset
    map: str = ""  # mapping file, .toml or .json; only exports of starjax need none
    accept: bool = False  # exit code 0 in spite of notes
    format: str = options.AUTO  # format: lerobot, robomimic or zarr; auto: detected


def main(argv: Sequence[str]) -> int:
    """Writes the dataset; prints its anomalies, and returns 1 if there are any."""
    args = options.parse("import", ImportArgs, argv, DESCRIPTION)
    checks.expect_folder("OUT", args.out)
    xla.prepare_xla()
    from starjax.data import store
    from starjax.data.formats import base

    path, out = Path(args.path), Path(args.out)
    checks.expect(not store.is_sealed(out), "OUT", "a directory without a dataset", out)
    if args.format != options.AUTO:
        errors.choice("format", args.format, base.FORMATS.names())
    name = base.detect(path) if args.format == options.AUTO else args.format
    with base.open_dataset(path, name) as source:
        if not args.map:
            return _bring_back(source, path, out)
        return _mapped(source, Path(args.map), out, args.accept)


def _bring_back(source: Any, path: Path, out: Path) -> int:
    from starjax.data.formats import exchange

    if source.origin is None:
        raise errors.UsageError(
            "PATH", "an export of starjax, or a --map", path, "starjax inspect shows its columns"
        )
    with progress.track("Import", len(source.lengths), unit="episodes") as advance:
        restored = exchange.restore_export(source, out, advance)
    same = "every byte as it was" if restored["same"] else "images or an earlier schema changed"
    print(f"{out}: {restored['episodes']} demonstrations, {same}; digest {restored['digest'][:12]}")
    return 0


def _mapped(source: Any, map_path: Path, out: Path, accept: bool) -> int:
    from starjax.data import schema
    from starjax.data.formats import foreign, mapping

    columns = mapping.load(map_path)
    with progress.track("Import", 2 * len(source.lengths), unit="episodes read") as advance:
        imported = foreign.import_mapped(source, columns, out, map_path.parent, advance)
    for line in imported.notes[:_SHOWN]:
        messages.indented(line)
    if len(imported.notes) > _SHOWN:
        messages.indented(f"and {len(imported.notes) - _SHOWN} more, see {out / schema.IMPORTED}")
    worst = f"{imported.residual_mm.max():.2g} mm or less (root mean square)"
    counts = f"{imported.episodes} demonstrations, {imported.frames} frames"
    print(f"{out}: {counts}, {imported.left_out} left out")
    print(f"shafts pass their trocars at {worst}")
    print(f"starjax train --demos.from {shlex.quote(str(out))} --task {columns.task} trains on it")
    if imported.notes and not accept:
        print(f"{len(imported.notes)} notes: exit code 1 unless --accept")
        return 1
    return 0
