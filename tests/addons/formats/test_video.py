"""Images survive a video of any writer."""

import fractions

import av
import numpy as np
import pytest

from starjax.addons.formats import video

SIZE = 32


def colourful(count=8):
    """`[count, 32, 32, 3]` of tiles of all colours, four pixels wide and at odd places."""
    tiles = np.random.default_rng(0).integers(16, 240, (count, 9, 9, 3))
    return tiles.repeat(4, 1).repeat(4, 2)[:, 1 : SIZE + 1, 1 : SIZE + 1].astype(np.uint8)


def test_small_coloured_things_keep_their_colours(tmp_path):
    images = colourful()
    film = video.Writer(tmp_path / "film.mp4", images.shape[1:], 30)
    film.append(images)
    film.close()
    found = video.read(tmp_path / "film.mp4", 0.0, len(images), 30.0, images.shape[1:])
    off = found.astype(float) - images
    assert 10 * np.log10(255**2 / np.mean(off**2)) >= 27.0  # 17 with half of the colours
    assert np.abs(off.mean((0, 1, 2))).max() < 0.5


@pytest.mark.parametrize("said", [None, "ITU709"])
def test_videos_of_others_are_read_neither_darker_nor_in_other_colours(tmp_path, said):
    """Colours at half the resolution, of which plain areas lose nothing."""
    images = np.broadcast_to(colourful(80)[:, :1, :1], (80, SIZE, SIZE, 3))
    path = tmp_path / "theirs.mp4"
    with av.open(str(path), "w") as file:
        stream = file.add_stream("libx264", rate=30, options={"crf": "4", "g": "1"})
        stream.width, stream.height, stream.pix_fmt = SIZE, SIZE, "yuv420p"
        stream.time_base = fractions.Fraction(1, 30)
        if said:
            stream.codec_context.colorspace = av.video.reformatter.Colorspace[said].value
        for image in images:
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            file.mux(stream.encode(frame.reformat(format="yuv420p", dst_colorspace=said)))
        file.mux(stream.encode(None))
    off = video.read(path, 0.0, len(images), 30.0, images.shape[1:]).astype(float) - images
    assert np.abs(off).max() <= 4.0
    assert np.abs(off.mean((0, 1, 2))).max() < 0.75
