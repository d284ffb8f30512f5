"""Damages exports at random and reads them: each ends in arrays or in one line, never otherwise.

`python tests/addons/fuzz_formats.py FORMAT COUNT [SEED]` uses processes of its own:
a crash of a library is counted too. A damage that takes longer than `LIMIT_S` ends its process,
too, and its stack goes to stderr. The damaged files of such an end are kept.
"""

import collections
import faulthandler
import json
import multiprocessing
import os
import random
import resource
import shutil
import sys
import tempfile
from pathlib import Path
from typing import IO

import recorded

from starjax.addons.formats import base, exchange
from starjax.core import errors
from starjax.runtime import files

BATCH = 4000  # damages a process
LIMIT_S = 60.0  # time of one damage, which takes milliseconds
JSON_VALUES = (
    None,
    -1,
    0,
    2**31,
    10**30,
    1e308,
    "",
    "../../x",
    "/etc/passwd",
    [],
    {},
    True,
    [[-5]],
)


def prepared(folder: Path, name: str, whole: bool = False) -> Path:
    """A small export with images."""
    recorded.write(folder / "d", size=8, demos=2, length=6)
    form = base.FORMATS.get(name)
    out = folder / f"out{'.hdf5' if name == 'robomimic' else ''}"
    source = exchange.source(folder / "d", form)
    # Half of the fields are enough: they are read alike.
    twice = [column for column in source.columns if base.OURS in column]
    kept = {n: c for n, c in source.columns.items() if whole or n not in twice}
    exchange.export(source._replace(columns=kept), out, form, video=True)
    return out


def parts(path: Path) -> list[Path]:
    """Its files, without unread text."""
    found = [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file())
    return [p for p in found if p.suffix != ".md"]


def damaged(data: bytes, random: random.Random, is_json: bool) -> bytes:
    """A file's content after one accident."""
    if is_json and random.random() < 0.6:
        return _edited(data, random)
    found = bytearray(data)
    # Headers are at the ends of files.
    near = min(len(found), random.choice((64, 512, 4096, len(found))))
    at = random.choice((0, len(found) - near)) + random.randrange(max(near, 1))
    kind = random.choice(("flip", "flip", "bytes", "cut", "zero", "twice", "grow"))
    length = random.randrange(1, 64)
    if kind == "flip":
        for _ in range(random.randrange(1, 5)):
            i = min(len(found) - 1, at + random.randrange(16))
            found[i] ^= 1 << random.randrange(8)
    elif kind == "bytes":
        found[at : at + length] = random.randbytes(length)
    elif kind == "cut":
        del found[at:]
    elif kind == "zero":
        found[at : at + length] = bytes(len(found[at : at + length]))
    elif kind == "twice":
        found[at:at] = found[at : at + length]
    else:
        found[at:at] = random.randbytes(length)
    return bytes(found)


def _edited(data: bytes, random: random.Random) -> bytes:
    """JSON with one value replaced, or one name."""
    whole = json.loads(data)
    spots, stack = [], [whole]
    while stack:
        node = stack.pop()
        inside = node.items() if isinstance(node, dict) else enumerate(node)
        for key, value in inside:
            spots.append((node, key))
            if isinstance(value, dict | list):
                stack.append(value)
    if not spots:
        return json.dumps(random.choice(JSON_VALUES)).encode()
    node, key = random.choice(spots)
    if isinstance(node, dict) and random.random() < 0.2:
        node["../" + str(key)] = node.pop(key)
    else:
        node[key] = random.choice(JSON_VALUES)
    return json.dumps(whole).encode()


def attempt(path: Path, name: str, root: Path | None = None) -> str:
    """Its outcome: `read`, `refused`, or an unexpected exception.

    Args:
      root: folder of the files and of a restored export.
    """
    try:
        with base.open_dataset(path, name) as source:
            for episode in range(min(len(source.lengths), 3)):
                source.read(episode, source.columns)
            if root and source.origin is not None:
                exchange.restore_export(source, root)
        return "read"
    except errors.UsageError as error:
        return "refused" if "\n" not in str(error) else f"several lines: {error}"
    except files.StorageError:
        return "refused"
    except BaseException as error:
        return f"{type(error).__name__}: {error}"


def run(
    path: Path, name: str, count: int, seed: int, back: bool = False, hung: IO[str] | None = None
) -> collections.Counter:
    """As many accidents, each to one file of a sound export, which is sound again afterwards.

    Args:
      hung: file for the stack of a read that takes too long, before the process ends.
    """
    found, draws = collections.Counter(), random.Random(seed)
    among = parts(path)
    sound = {part: part.read_bytes() for part in among}
    for number in range(count):
        part = draws.choice(among)
        is_json = part.suffix == ".json" or part.name in (".zattrs", ".zarray", ".zgroup")
        part.write_bytes(damaged(sound[part], draws, is_json))
        root = path.parent / f"deep/er/back{number}" if back else None
        if hung:
            faulthandler.dump_traceback_later(LIMIT_S, exit=True, file=hung)
        said = attempt(path, name, root)
        found[said if said in ("read", "refused") else f"{part.name}: {said}"[:300]] += 1
        part.write_bytes(sound[part])
    return found


def _child(queue, folder: Path, name: str, count: int, seed: int) -> None:
    complaints = os.fdopen(os.dup(2), "w")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # libraries in C complain there
    queue.put(run(prepared(folder, name), name, count, seed, hung=complaints))
    faulthandler.cancel_dump_traceback_later()


def main(name: str, count: int, seed: int = 0) -> None:
    """Prints the outcomes so far after every process, and CPU seconds, those of starting too."""
    total, context = collections.Counter(), multiprocessing.get_context("spawn")
    for start in range(0, count, BATCH):
        queue, folder = context.Queue(), Path(tempfile.mkdtemp())
        size = min(BATCH, count - start)
        process = context.Process(target=_child, args=(queue, folder, name, size, seed + start))
        process.start()
        while process.is_alive() and queue.empty():
            process.join(0.2)
        if queue.empty() and process.exitcode:
            total[f"process ended with {process.exitcode}, see {folder}"] += 1
        else:
            total += queue.get()
            process.join()
            shutil.rmtree(folder)
        spent = resource.getrusage(resource.RUSAGE_CHILDREN)
        cpu_s = spent.ru_utime + spent.ru_stime
        print(f"{name} {sum(total.values())} {dict(total)} {cpu_s:.0f} CPU s", flush=True)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), *map(int, sys.argv[3:]))
