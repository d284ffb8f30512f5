"""Features of a frozen vision encoder, computed once for every frame and kept on disk.

    <root>/features/<key>/part_<n>.npz    `[PART, d_v]` float32, of consecutive frames

The key is a hash of all that decides the features: a resumed run, or another method with the same
encoder, finds them. Archives have checksums: a damaged part is noticed and made again.
"""

import functools
import hashlib
import json
from collections.abc import Callable, Generator, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from starjax.core import config
from starjax.core.types import Array, ArrayTree
from starjax.data import redraw
from starjax.policies import features as inputs
from starjax.policies import generator
from starjax.runtime import files, progress
from starjax.runtime.precompile import Program
from starjax.sim.rollouts import workers
from starjax.training.encoder import Encoder

PART = 1024  # frames per file, lost at most by a kill


def features(
    encoder: Encoder,
    policy_config: config.PolicyConfig,
    root: Path,
    digest: str,
    count: int,
    camera: str,
    frames: Callable[[], Any],
    report: Callable[[str], None] = print,
    rows: np.ndarray | None = None,
) -> np.ndarray:
    """Computes features `[F, d_v]` float32 of frames' centre crops, as inference sees them.

    Args:
      encoder: stays as it is.
      policy_config: networks.
      root: folder of the demonstrations.
      digest: hash that names their content.
      count: F.
      camera: whose images they are, by name.
      frames: gives them, uint8 `[F, h, w, 3]` as `windows.Dataset` may hold them; called only if
        something is missing.
      report: gets lines for the user.
      rows: `[R]` the frames that training reads, None for all; features of the others are zero.

    Raises:
      StorageError: the folder cannot be written.
    """
    read = np.arange(count) if rows is None else rows
    folder = root / "features" / _key(encoder, policy_config, digest, camera, rows)
    spans = [(first, min(first + PART, len(read))) for first in range(0, len(read), PART)]
    paths = [folder / f"part_{number:04d}.npz" for number in range(len(spans))]
    spans_of = dict(zip(paths, spans, strict=True))
    parts = _stored(spans_of, policy_config.vision_dim, report)
    if missing := len(paths) - len(parts):
        # Other runs may train on the same demonstrations: the first one computes, the others wait.
        with files.lock(folder, waits=True):
            parts = _stored(spans_of, policy_config.vision_dim, lambda line: None)
            if missing := len(paths) - len(parts):
                parts |= _computed(encoder, policy_config, frames(), read, spans_of, parts)
    joined = np.zeros((count, policy_config.vision_dim), np.float32)
    joined[read] = np.concatenate([parts[path] for path in paths])
    origin = "in" if missing else "reused from"
    report(f"features of {len(read)} frames, {files.size(joined.nbytes)}: {origin} {folder}")
    return joined


def _stored(
    spans: Mapping[Path, tuple[int, int]], width: int, report: Callable[[str], None]
) -> dict[Path, np.ndarray]:
    """Returns the finished parts among `spans`."""
    found = {
        path: _read(path, (last - first, width), report) for path, (first, last) in spans.items()
    }
    return {path: part for path, part in found.items() if part is not None}


def _computed(
    encoder: Encoder,
    policy_config: config.PolicyConfig,
    pictures: Any,
    read: np.ndarray,
    spans: Mapping[Path, tuple[int, int]],
    known: Mapping[Path, np.ndarray],
) -> dict[Path, np.ndarray]:
    """Computes and writes the parts of `spans` that are not `known`; `read` are their frames."""
    see = functools.partial(_see_program(policy_config), jax.device_put(encoder.params))
    batch = redraw.batch_size()
    is_drawn = isinstance(pictures, redraw.DrawnImages)
    look = pictures.draw_batch if is_drawn else pictures.__getitem__
    parts: dict[Path, np.ndarray] = {}

    def make(path: Path) -> Generator[int]:
        """Yields the number of frames of each batch."""
        first, last = spans[path]
        batches = []
        for start in range(first, last, batch):
            index = read[np.minimum(np.arange(start, start + batch), last - 1)]
            batches.append(np.asarray(see(look(index)))[: last - start])
            yield len(batches[-1])
        parts[path] = np.concatenate(batches)
        files.write_npz(path, {"features": parts[path]})

    done = sum(map(len, known.values()))
    missing = [path for path in spans if path not in known]
    with progress.track("Features", len(read), unit="frames", done=done) as advance:
        for count_done in workers.run(missing, make, workers.worker_count()):
            advance(count_done)
    return parts


def precompile(encoder: Encoder, policy_config: config.PolicyConfig, frames: Array) -> None:
    """Compiles, in the background, the program of `features`, for batches of this shape."""
    _see_program(policy_config).prepare(encoder.params, frames)


@functools.lru_cache(maxsize=4)
def _see_program(policy_config: config.PolicyConfig) -> Program:
    """Returns the program of parameters and frames `[B, h, w, 3]` uint8 -> features `[B, d_v]`."""
    vision = generator.vision_encoder(policy_config)

    def see(params: ArrayTree, frames: jax.Array) -> Any:
        return vision.apply(params, inputs.centre_crop(policy_config, frames))

    return Program(see)


def _key(
    encoder: Encoder,
    policy_config: config.PolicyConfig,
    digest: str,
    camera: str,
    rows: np.ndarray | None,
) -> str:
    """Returns the key of the features: a hash of all that they depend on."""
    about = {
        "encoder": encoder.fingerprint,
        "trunk": policy_config.encoder,
        "dtype": policy_config.dtype,
        "crop": inputs.crop_size(policy_config),
        "demonstrations": digest,
        "camera": camera,
        **({} if rows is None else {"frames": hashlib.sha256(rows.tobytes()).hexdigest()}),
    }
    return hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()[:16]


def _read(path: Path, shape: tuple[int, int], report: Callable[[str], None]) -> np.ndarray | None:
    """Returns a finished part, or None if it is missing or damaged."""
    try:
        part = files.read_npz(path, ["features"])["features"]
    except FileNotFoundError:
        return None
    except ValueError as error:
        report(f"{error}; computed again")
        return None
    if part.shape != shape or part.dtype != np.float32:
        expected = f"expected float32 {shape}, got {part.dtype} {part.shape}"
        report(f"{path} is damaged: {expected}; computed again")
        return None
    return part
