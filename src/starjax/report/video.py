"""The rollout video: recorded joint positions drawn again by the simulator's own camera."""

import contextlib
import itertools
import pathlib
import subprocess
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from starjax.report import outcomes, results, style

Draw = Callable[[results.Rollout, int], np.ndarray]

FPS = 30  # a picture a control step: real time
SIZE = 384  # pixels a side of one rollout's picture
_BAR = 44  # pixels of the caption over it
_HOLD = 1.5  # s that the last picture stays
_LONGEST = 12.0  # s shown of a rollout
_GAP = 4  # pixels between pictures
_MUTED = "#98a2ad"
_BATCH = 16  # pictures drawn in one call


def record(
    runs: Sequence[results.Run],
    sim: Any,
    path: pathlib.Path,
    report: Callable[[str], None] = print,
) -> pathlib.Path | None:
    """Draws a few recorded rollouts into the file `path`; returns None if there are none.

    Args:
      runs: of whose representatives `choose` picks.
      sim: `sim.model.SimModel`, what `Env.model` is.
      path: of the mp4.
      report: gets a line for the user.

    Raises:
      OSError, RuntimeError: the encoder failed, or there is none for this machine.
    """
    chosen = choose(results.representatives(runs))
    if not chosen:
        return None
    report(f"drawing {len(chosen)} rollouts for the video")
    write(frames(chosen, renderer(sim), f"sees the {results.observed(runs)}"), path)
    return path


def choose(runs: Sequence[results.Run], most: int = 4) -> list[tuple[str, results.Rollout]]:
    """(method, rollout) to show side by side, `most` at most.

    One run: half of them at seen and half at unseen trocars, spread over these, an even number if
    there are two or more. Several runs: one trial that as many of them as possible recorded, at an
    unseen trocar if there is one. The choice does not look at how a rollout ended.
    """
    if len(runs) > 1:
        return _same_trial(runs, most)
    pool = [r for run in runs for r in run.rollouts if r.qpos is not None]
    seen = _spread([r for r in pool if r.trial["seen"]], most // 2)
    unseen = _spread([r for r in pool if not r.trial["seen"]], most - len(seen))
    chosen = [*_spread([r for r in pool if r.trial["seen"]], most - len(unseen)), *unseen]
    even = len(chosen) if len(chosen) < 2 else len(chosen) // 2 * 2
    return [(runs[0].label, r) for r in chosen[:even]]


def frames(
    chosen: Sequence[tuple[str, results.Rollout]], draw: Draw, note: str = ""
) -> Iterator[np.ndarray]:
    """Pictures `[h, w, 3]` uint8 of the chosen rollouts side by side in real time, captions over.

    Drawn while they are asked for: a whole video would not fit the memory of a small machine.

    Args:
      chosen: from `choose`.
      draw: from `renderer`.
      note: said in every caption, such as what the policy observes.
    """
    clips = [_clip(draw, method, rollout, note) for method, rollout in chosen]
    last: list[np.ndarray] = []
    for now in itertools.zip_longest(*clips):
        # A clip that ends early stays as it ended.
        last = [old if new is None else new for new, old in zip(now, last or now)]
        yield _grid(last)
    for _ in range(round(_HOLD * FPS)):
        yield _grid(last)


def renderer(sim: Any, size: int = SIZE) -> Draw:
    """Builds `draw(rollout, first) -> [_BATCH, size, size, 3]` uint8 from step `first` on.

    Args:
      sim: `sim.model.SimModel`, what `Env.model` is.
    """
    import jax

    from starjax.sim import physics, render

    # Smooth outlines cost four times as much: a matter of seconds on a GPU, of minutes on a CPU.
    samples = 1 if jax.default_backend() == "cpu" else 2
    camera = render.make(sim.mj_model, "camera", size, size, samples=samples)

    @jax.jit
    def batch(qpos: jax.Array, port: jax.Array, target: jax.Array) -> jax.Array:
        rgb = physics.colours(sim, target)

        def one(q: jax.Array) -> jax.Array:
            return camera(*physics.geom_poses(sim, q, port), rgb).rgb

        return jax.lax.map(one, qpos)

    def draw(rollout: results.Rollout, first: int) -> np.ndarray:
        if rollout.qpos is None:
            raise ValueError("rollout: expected one with joint positions, got none")
        rows = np.minimum(np.arange(first, first + _BATCH), len(rollout.qpos) - 1)
        port, target = rollout.p_world_trocar.astype(np.float32), np.int32(rollout.target_peg)
        with jax.default_matmul_precision("highest"):  # poses to float32, as the environment's
            return np.asarray(batch(rollout.qpos[rows].astype(np.float32), port, target))

    return draw


def write(pictures: Iterable[np.ndarray], path: pathlib.Path, fps: int = FPS) -> None:
    """Writes `[h, w, 3]` uint8 pictures as H.264 in yuv420p, which every browser plays.

    The file appears whole or not at all.

    Raises:
      OSError, RuntimeError: the encoder failed, or there is none for this machine.
    """
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise RuntimeError(f"the video's encoder is missing ({error})") from error
    stream = iter(pictures)
    first = next(stream)
    if first.dtype != np.uint8 or first.ndim != 3 or any(n % 2 for n in first.shape[:2]):
        said = f"{first.dtype} {list(first.shape)}"
        raise ValueError(f"pictures: expected uint8 [h, w, 3] with h and w even, got {said}")
    size = f"{first.shape[1]}x{first.shape[0]}"
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", str(fps), "-i", "-"]
    coded = ["-c:v", "libx264", "-crf", "23", "-pix_fmt", "yuv420p", "-movflags", "+faststart"]
    # Not imageio's own writer: it forks, and jax's threads do not survive a fork.
    program = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error"]
    staged = path.with_name(f".{path.name}")  # its ending tells the encoder what to write
    with subprocess.Popen(
        # Not to be taken for an option, or for a protocol.
        [*program, *source, *coded, f"file:{staged}"],
        stdin=subprocess.PIPE,
        stderr=subprocess.PIPE,
    ) as encoder:
        assert encoder.stdin and encoder.stderr
        # A pipe breaks when the encoder has given up; it has said why.
        with contextlib.suppress(BrokenPipeError):
            for picture in itertools.chain([first], stream):
                encoder.stdin.write(np.ascontiguousarray(picture).data)
            encoder.stdin.close()
        said = encoder.stderr.read().decode().strip()
    if encoder.returncode:
        staged.unlink(missing_ok=True)
        raise OSError(f"{path}: the video could not be written: {said or encoder.returncode}")
    staged.replace(path)


def caption(rows: Sequence[Sequence[tuple[str, str]]], width: int) -> np.ndarray:
    """`[_BAR, width, 3]` uint8: a dark bar with rows of two (text, colour), left and right."""
    from PIL import Image, ImageDraw, ImageFont

    line = _BAR / len(rows)
    data = style.library().get_data_path()
    font = ImageFont.truetype(f"{data}/fonts/ttf/DejaVuSans.ttf", round(0.58 * line))
    image = Image.new("RGB", (width, _BAR), "#14181c")
    pen = ImageDraw.Draw(image)
    for i, row in enumerate(rows):
        for (text, color), (x, anchor) in zip(row, ((10, "lm"), (width - 10, "rm"))):
            pen.text((x, line * (i + 0.55)), text, fill=color, font=font, anchor=anchor)
    return np.asarray(image)


def _clip(draw: Draw, method: str, rollout: results.Rollout, note: str) -> Iterator[np.ndarray]:
    """Pictures of one rollout under a bar: what is shown, the clock, and at the end the outcome."""
    kind, index = "seen" if rollout.trial["seen"] else "unseen", rollout.trial["trocar"]
    total = len(rollout.p_world_tip)
    steps = min(total, round(_LONGEST * FPS))
    won = outcomes.strict(rollout.trial)
    end = "success" if won else outcomes.SHORT[outcomes.failure(rollout.trial)]
    outcome = (f"{end}, {total / FPS:.1f} s", "#5ab4e8" if won else "#f09a5a")
    cut = "" if steps == total else f"first {steps // FPS} s shown"
    about = (f"{kind} trocar {index}" + (f", {note}" if note else ""), _MUTED), (cut, _MUTED)
    for first in range(0, steps, _BATCH):
        for step, picture in enumerate(draw(rollout, first)[: steps - first], start=first):
            now = outcome if step == steps - 1 else (f"{step // FPS} s", _MUTED)
            bar = caption([[(method, "#e6e9ec"), now], about], picture.shape[1])
            yield np.concatenate([bar, picture])


def _grid(tiles: Sequence[np.ndarray]) -> np.ndarray:
    """Tiles `[h, w, 3]` in rows of two, three in one row, `_GAP` dark pixels between them."""
    h, w = tiles[0].shape[:2]
    columns = len(tiles) if len(tiles) <= 3 else 2
    rows = -(-len(tiles) // columns)
    grid = np.full(((h + _GAP) * rows - _GAP, (w + _GAP) * columns - _GAP, 3), 20, np.uint8)
    for i, tile in enumerate(tiles):
        y, x = (h + _GAP) * (i // columns), (w + _GAP) * (i % columns)
        grid[y : y + h, x : x + w] = tile
    return grid


def _spread(rollouts: list[results.Rollout], most: int) -> list[results.Rollout]:
    """Up to `most` of them, spread evenly; each trocar's first trial before any second one."""
    ordered = sorted(rollouts, key=lambda r: (r.trial["trial"], r.trial["trocar"]))
    first = [r for r in ordered if r.trial["trial"] == ordered[0].trial["trial"]]
    pool = first if len(first) >= most else ordered
    picks = np.linspace(0, len(pool) - 1, min(most, len(pool))).round().astype(int)
    return [pool[i] for i in picks]


def _same_trial(runs: Sequence[results.Run], most: int) -> list[tuple[str, results.Rollout]]:
    """The same trial of up to `most` runs; the last ones where there are more."""
    kept = [
        {results.identity(r.trial): r for r in run.rollouts if r.qpos is not None} for run in runs
    ]
    found = [(run.label, rollouts) for run, rollouts in zip(runs, kept) if rollouts][-most:]
    if not found:
        return []
    pick = results.most_shared(r.trial for _, rollouts in found for r in rollouts.values())
    return [(label, rollouts[pick]) for label, rollouts in found if pick in rollouts]
