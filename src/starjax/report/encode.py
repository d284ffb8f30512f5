"""Images as an H.264 video, with imageio-ffmpeg's encoder."""

import contextlib
import itertools
import pathlib
import subprocess
from collections.abc import Iterable

import numpy as np


def write(images: Iterable[np.ndarray], path: pathlib.Path, fps: float) -> None:
    """Writes `[h, w, 3]` uint8 images as H.264 in yuv420p, which every browser plays.

    The file appears whole or not at all.

    Raises:
      OSError, RuntimeError: the encoder failed or is not installed.
    """
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise RuntimeError(f"the video's encoder is missing ({error})") from error
    stream = iter(images)
    first = next(stream)
    if first.dtype != np.uint8 or first.ndim != 3 or any(n % 2 for n in first.shape[:2]):
        got = f"{first.dtype} {list(first.shape)}"
        raise ValueError(f"images: expected uint8 [h, w, 3] with h and w even, got {got}")
    size = f"{first.shape[1]}x{first.shape[0]}"
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", str(fps), "-i", "-"]
    coded = ["-c:v", "libx264", "-crf", "23", "-pix_fmt", "yuv420p", "-movflags", "+faststart"]
    # imageio's own writer forks, and jax's threads do not survive a fork.
    program = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error"]
    staged = path.with_name(f".{path.name}")  # the suffix selects the container
    with subprocess.Popen(
        # "file:" keeps a path from being read as an option or a protocol.
        [*program, *source, *coded, f"file:{staged}"],
        stdin=subprocess.PIPE,
        stderr=subprocess.PIPE,
    ) as encoder:
        assert encoder.stdin and encoder.stderr
        # The pipe breaks when the encoder fails; its reason is on stderr.
        with contextlib.suppress(BrokenPipeError):
            for image in itertools.chain([first], stream):
                encoder.stdin.write(np.ascontiguousarray(image).data)
            encoder.stdin.close()
        message = encoder.stderr.read().decode().strip()
    if encoder.returncode:
        staged.unlink(missing_ok=True)
        raise OSError(f"{path}: the video could not be written: {message or encoder.returncode}")
    staged.replace(path)
