"""`starjax import`: restores exports, and imports other datasets by a mapping file."""

import dataclasses
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from starjax.cli import checks, messages, options
from starjax.core import errors
from starjax.runtime import hub, progress, xla

if TYPE_CHECKING:  # for annotations alone
    from starjax.addons.formats import base

_PIXELS = 128  # pixels per side of images that --cameras names
_SHOWN = 10  # anomalies, the others are in a file
DESCRIPTION = """Imports demonstrations in another format as a dataset to train on.

PATH is a dataset in one of the formats of starjax list, OUT the new dataset. An export of starjax
is restored exactly. For other datasets, a mapping describes the columns: a file, or one of the
package (starjax list), by default the one that fits.

Examples:
  starjax import out/lerobot runs/restored
  starjax import recordings runs/recordings --map columns.toml"""


@dataclasses.dataclass(frozen=True)
class ImportArgs:
    """Flags of the command."""

    path: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="PATH")]  # dataset to import
    out: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]  # new dataset
    map: str = ""  # mapping file, .toml or .json, or a name; empty: the one that fits
    skip: tuple[int, ...] = ()  # episodes to leave out, by their numbers in the files
    # columns of images, as camera=observation.images.left; empty: the mapping's
    cameras: tuple[str, ...] = ()
    splits: tuple[str, ...] = ()  # splits to import, e.g. train recovery; empty: all
    accept: bool = False  # exit code 0 in spite of notes
    # lerobot, lerobot-v2.1, aloha, robomimic, zarr, rosbag, jigsaws or csv; auto: detected
    format: str = options.AUTO


def main(argv: Sequence[str]) -> int:
    """Writes the dataset; prints its anomalies, and returns 1 if there are any."""
    args = options.parse("import", ImportArgs, argv, DESCRIPTION)
    checks.expect_folder("OUT", args.out)
    xla.prepare_xla()
    from starjax.addons.formats import base
    from starjax.data import store

    path, out = hub.dataset("PATH", args.path), Path(args.out)
    checks.expect(not store.is_sealed(out), "OUT", "a directory without a dataset", out)
    if args.format != options.AUTO:
        errors.choice("format", args.format, base.FORMATS.names())
    name = base.detect(path) if args.format == options.AUTO else args.format
    with base.open_dataset(path, name) as source:
        if source.origin is not None and not args.map:
            return _bring_back(source, out)
        return _mapped(source, args, out)


def _cameras(given: Sequence[str]) -> dict[str, Any]:
    """Parses columns of images: a camera of the task, `=`, a column."""
    from starjax.addons.formats.mapping import CameraColumn

    pairs = [text.partition("=") for text in given]
    for text, (name, _, column) in zip(given, pairs):
        checks.expect(bool(name and column), "--cameras", "CAMERA=COLUMN", text)
    return {name: CameraColumn(column=column, size=_PIXELS) for name, _, column in pairs}


def _bring_back(source: "base.Source", out: Path) -> int:
    from starjax.addons.formats import exchange

    with progress.track("Import", len(source.lengths), unit="episodes") as advance:
        restored = exchange.restore_export(source, out, advance)
    same = "every byte as it was" if restored["same"] else "images or an earlier schema changed"
    print(f"{out}: {restored['episodes']} demonstrations, {same}; digest {restored['digest'][:12]}")
    return 0


def _mapped(source: "base.Source", args: ImportArgs, out: Path) -> int:
    from msgspec import structs

    from starjax.addons.formats import base, foreign, mapping, own_columns, ready
    from starjax.data import schema

    own = own_columns.mapping(source) if args.map in ("", base.OURS) else None
    if args.map == base.OURS and own is None:
        raise errors.UsageError("--map", f"columns {base.OURS}.* of an export", "none of them")
    name = args.map or (base.OURS if own else ready.choose(source))
    map_path = ready.FOLDER / name if own else ready.find(name)
    columns = own or mapping.load(map_path)
    given = {"skip": args.skip, "splits": args.splits, "cameras": _cameras(args.cameras)}
    columns = structs.replace(columns, **{key: value for key, value in given.items() if value})
    if map_path.parent == ready.FOLDER:
        print(f"mapping {name}: {columns.about}")
    with progress.track("Import", 2 * len(source.lengths), unit="readings") as advance:
        imported = foreign.import_mapped(source, columns, out, map_path.parent, advance)
    lines = [*imported.remarks, *imported.notes]
    for line in lines[:_SHOWN]:
        messages.indented(line)
    if (more := len(lines) - _SHOWN) > 0:
        messages.indented(f"and {more} more, see {out / schema.IMPORTED}")
    worst = f"{imported.residual_mm.max():.2g} mm or less (root mean square)"
    counts = f"{imported.episodes} demonstrations, {imported.frames} frames"
    print(f"{out}: {counts}, {imported.left_out} left out")
    print(f"shafts pass their trocars at {worst}")
    begin = f"starjax train --demos.from {shlex.quote(str(out))} --task {columns.task} trains on"
    print(f"{begin} the {imported.successes} successes of {imported.episodes}")
    if imported.notes and not args.accept:
        print(f"{len(imported.notes)} notes: exit code 1 unless --accept")
        return 1
    return 0
