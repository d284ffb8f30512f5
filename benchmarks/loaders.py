"""Random frames of a dataset's images from disk: our reader, and grain's loader.

    pip install grain
    python benchmarks/loaders.py DATASET

Each loader runs in a process of its own, twice in turn, from files that no cache holds. grain reads
by numpy's maps, like its own sources of files, and by our reader.
"""

import argparse
import json
import os
import pathlib
import subprocess
import sys
import time
from collections.abc import Iterator

import _timing
import numpy as np

from starjax.data import load
from starjax.data.episode_array import EpisodeArray

BATCH, ROUNDS, SECONDS = 64, 2, 15.0  # frames; runs of each loader; of a run
THREADS, AHEAD = 16, 4  # threads of grain, as ours; batches
LOADERS = ("ours", "grain, numpy's maps", "grain, our reader")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dataset", type=pathlib.Path)
    parser.add_argument("--loader", choices=LOADERS, help="this one alone, in this process")
    asked = parser.parse_args()
    if asked.loader:
        print(json.dumps(measured(asked.dataset, asked.loader)))
        return
    rows = {loader: [] for loader in LOADERS}
    for loader in LOADERS * ROUNDS:
        command = [sys.executable, __file__, str(asked.dataset), "--loader", loader]
        line = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        rows[loader].append(json.loads(line.splitlines()[-1]))
        print(loader, rows[loader][-1], flush=True)
    print(f"wrote {_timing.write('loaders', {'results': rows})}")


def measured(root: pathlib.Path, loader: str) -> dict[str, float]:
    """Returns the rate after the first batch, and the memory of this process without files."""
    (frames,) = load.frames(root).values()
    assert isinstance(frames, EpisodeArray)
    for path in frames._paths:
        descriptor = os.open(path, os.O_RDONLY)
        os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
        os.close(descriptor)
    batches = ours(frames) if loader == "ours" else grains(frames, loader)
    next(batches)
    start, count = time.monotonic(), 0
    while (spent := time.monotonic() - start) < SECONDS:
        count += len(next(batches))
    status = pathlib.Path("/proc/self/status").read_text().split()
    memory = int(status[status.index("RssAnon:") + 1]) // 1024
    return {"frames_per_s": round(count / spent), "rss_anon_mb": memory}


def ours(frames: EpisodeArray) -> Iterator[np.ndarray]:
    random = np.random.default_rng(0)
    while True:
        yield frames[random.integers(0, frames.shape[0], BATCH)]


def grains(frames: EpisodeArray, loader: str) -> Iterator[np.ndarray]:
    import grain

    paths, start = frames._paths, frames._start

    def mapped(index: int) -> np.ndarray:
        episode = int(np.searchsorted(start, index, side="right") - 1)
        return np.array(np.load(paths[episode], mmap_mode="r")[index - start[episode]])

    class Frames:
        def __len__(self) -> int:
            return frames.shape[0]

        def __getitem__(self, index: int) -> np.ndarray:
            return frames[np.array(index)] if "our" in loader else mapped(index)

    options = grain.ReadOptions(num_threads=THREADS, prefetch_buffer_size=AHEAD * BATCH)
    data = grain.MapDataset.source(Frames()).shuffle(seed=0).repeat()
    return iter(data.to_iter_dataset(options).batch(BATCH))


if __name__ == "__main__":
    main()
