"""Videos of episodes: frames in and out by PyAV, by their times."""

import contextlib
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np

from starjax.addons.formats import base

CODEC = "h264"
PIXELS = "yuv444p"  # with half of the colours, small coloured things lose 8 dB
_OPTIONS = {"crf": "12", "preset": "fast", "g": "2"}  # as good as unseen; every second frame whole
# Without them colours are cut, not rounded: images of yuv420p come back darker by 1 or 2 of 255.
_ROUNDED = "flags=bicubic+accurate_rnd+full_chroma_int"


class Writer:
    """Appends episodes to one video file."""

    def __init__(self, path: Path, shape: tuple[int, ...], hz: int):
        self._hz, self.frames = hz, 0
        self._file = av.open(str(path), "w", options={"movflags": "faststart"})
        self._stream = self._file.add_stream("libx264", rate=hz, options=_OPTIONS)
        self._stream.height, self._stream.width = shape[:2]
        self._stream.pix_fmt = PIXELS
        self._stream.time_base = Fraction(1, hz)

    def append(self, images: np.ndarray) -> None:
        """Takes frames `[T, h, w, 3]` uint8."""
        for image in images:
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            frame.pts, frame.time_base = self.frames, Fraction(1, self._hz)
            self._file.mux(self._stream.encode(frame))
            self.frames += 1

    @property
    def seconds(self) -> float:
        """Time of the next frame in s."""
        return self.frames / self._hz

    def close(self) -> None:
        """Ends the file."""
        self._file.mux(self._stream.encode(None))
        self._file.close()


def read(path: Path, first: float, length: int, hz: float, shape: tuple[int, ...]) -> np.ndarray:
    """Reads frames `[length, h, w, 3]` of a video, from the time `first` in s on.

    Raises:
      Damaged: a frame is not where its time says, or is of another size.
    """
    base.require(path.is_file(), "a video", f"none at {path}")
    base.require_fits(path.name, (length, *shape), np.uint8)
    frames = np.zeros((length, *shape), np.uint8)
    count = 0
    with contextlib.closing(av.open(str(path))) as file:
        base.require(bool(file.streams.video), "a video stream", f"none in {path}")
        for seconds, frame in _frames(file, first):
            index = round((seconds - first) * hz)
            if index < 0:
                continue
            if index >= length:
                break
            is_near = index == count and abs(seconds - first - index / hz) < 0.5 / hz
            base.require(is_near, f"frame {count} of {path.name}", f"one at {seconds:.3f} s")
            image = frame.to_ndarray()
            base.require(image.shape == shape, f"frames {list(shape)}", list(image.shape))
            frames[count], count = image, count + 1
    base.require(count == length, f"{length} frames in {path.name}", count)
    return frames


def _frames(file: "av.container.InputContainer", first: float) -> Iterator[tuple[float, Any]]:
    stream = file.streams.video[0]
    stream.thread_type = "AUTO"
    if first > 0.0:
        file.seek(max(0, int((first - 0.5) / stream.time_base)), stream=stream)
    colours = _colours(stream)
    for frame in file.decode(stream):
        colours.push(frame)
        yield float(frame.pts * frame.time_base), colours.pull()


def _colours(stream: "av.VideoStream") -> Any:
    """Builds the filter graph from a stream's frames to RGB."""
    graph = av.filter.Graph()
    scale = graph.add("scale", _ROUNDED), graph.add("format", "rgb24")
    graph.link_nodes(graph.add_buffer(template=stream), *scale, graph.add("buffersink"))
    graph.configure()
    return graph
