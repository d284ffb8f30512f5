"""Images of recorded episodes, drawn when they are needed: an image is a function of the state.

A dataset keeps joint positions and the numbers of its trials. The layout and the cameras' poses of
an episode follow from the key of its trial, just like in the recording.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from starjax.core import errors
from starjax.data import schema
from starjax.rcm.trocar import Trocar
from starjax.runtime.precompile import Program
from starjax.sim.rollouts import episodes, programs, workers
from starjax.sim.state import Env, EnvParams, ImageSource

# Images per call: as many on each device, because the batch size may change last bits. A core's
# cache holds 16; a GPU needs more to be busy.
CPU_BATCH, GPU_BATCH = 16, 1024

_LATE = {"late_view", "dropped"}  # streams of observation_delay and observation_dropout


class Sources(NamedTuple):
    """Data that the images of a dataset are a function of.

    Attributes:
      qpos: `[F, Q]` of every frame, and perhaps unused rows after them.
      episodes: `sim.state.ImageSource` of the episodes `[D]`; its `qpos` is empty.
    """

    qpos: Any
    episodes: Any

    def at(self, frame: jax.Array, episode: jax.Array) -> Any:
        """Returns the `ImageSource` `[...]` of frames `[...]` of episodes `[...]`."""
        sources = jax.tree.map(lambda leaf: leaf[episode], self.episodes)
        return sources._replace(qpos=self.qpos[frame])


class DrawnImages:
    """The images of one camera as if they were one array `[F, h, w, 3]` uint8, drawn when indexed.

    Attributes:
      shape: of the whole.
      dtype: uint8.
    """

    dtype = np.dtype(np.uint8)

    def __init__(
        self,
        draw: Callable[[Any, Any], jax.Array],
        qpos: np.ndarray,
        episode: np.ndarray,
        size: int,
    ):
        """Keeps what the images are drawn from.

        Args:
          draw: (qpos `[B, Q]`, episode `[B]`) -> images `[B, h, w, 3]`.
          qpos: `[F, Q]`.
          episode: `[F]` number of each frame's episode.
          size: pixels per side.
        """
        self._draw, self._qpos, self._episode = draw, np.asarray(qpos), np.asarray(episode)
        self.shape = (len(self._qpos), size, size, 3)

    def __getitem__(self, index: np.ndarray) -> np.ndarray:
        """Draws the images at `index`, integers `[...]`, as `[..., h, w, 3]` in host memory."""
        index = np.asarray(index)
        rows, batch = index.reshape(-1), batch_size()
        parts = []
        for first in range(0, len(rows), batch):
            part = rows[first : first + batch]
            parts.append(np.asarray(self.draw_batch(_padded(part, batch)))[: len(part)])
        shape = (*index.shape, *self.shape[1:])
        return np.concatenate(parts).reshape(shape) if parts else np.zeros(shape, self.dtype)

    def read_into(self, out: np.ndarray) -> None:
        """Draws all images into host memory `[F, h, w, 3]`, on all cores."""
        batch, count = batch_size(), self.shape[0]

        def draw(first: int):
            rows = np.arange(first, min(first + batch, count))
            out[rows] = np.asarray(self.draw_batch(_padded(rows, batch)))[: len(rows)]
            yield len(rows)

        for _ in workers.run(range(0, count, batch), draw, workers.worker_count()):
            pass

    def draw_batch(self, rows: np.ndarray) -> jax.Array:
        """Draws the images of `batch_size()` frames on the device."""
        return self._draw(self._qpos[rows], self._episode[rows])


def is_possible(description: Mapping[str, Any]) -> bool:
    """Returns True if images of a dataset can be drawn from what it recorded."""
    # Disturbances of the motion leave images a function of the state; older versions recorded
    # images with others, and observed an earlier state with those of `_LATE`.
    features, levels = description["features"], description.get("randomise", {})
    has_images = any(name.startswith(episodes.IMAGE) for name in features)
    is_undisturbed = not levels or not (has_images or _LATE & levels.keys())
    is_ours = description.get("seed_rule") == schema.seed_rule(schema.stream(description))
    return is_ours and is_undisturbed and "qpos" in features


def expect_possible(argument: str, description: Mapping[str, Any], hint: str = "") -> None:
    """Raises UsageError, with a hint, for a dataset whose images cannot be drawn."""
    if not is_possible(description):
        expected = "demonstrations of starjax, without recorded disturbances of observations"
        raise errors.UsageError(argument, expected, "others, whose images cannot be drawn", hint)


def are_recorded(description: Mapping[str, Any], env: Env) -> bool:
    """Returns True if a dataset holds images of an environment's cameras at its image size."""
    recorded = description["features"]
    return all(
        list(recorded.get(f"{episodes.IMAGE}{camera}", {}).get("shape", ())) == [size, size, 3]
        for camera, size in image_sizes(env).items()
    )


def image_sizes(env: Env) -> dict[str, int]:
    """Returns the pixels per side of each camera of an environment."""

    def look(key: jax.Array) -> Any:
        zeros = jnp.zeros(np.shape(env.p_world_ref)[0])
        return env.camera(env.reset(key, EnvParams(Trocar(zeros, zeros, zeros))))

    shapes = Program(look).shapes(jax.random.key(0))
    return {camera: frame.rgb.shape[0] for camera, frame in shapes.items()}


def scene_env(description: Mapping[str, Any], image_size: int) -> Any:
    """Builds the environment of a dataset's scene, with cameras of an image size."""
    from starjax.sim import env

    scene = description["scene"]
    return env.make(
        scene["task"],
        scene["arms"],
        scene["tools"],
        image_size=image_size,
        cameras=tuple(scene["cameras"]),
    )


def sources(
    root: Path, description: Mapping[str, Any], records: Sequence[Mapping[str, Any]], env: Env
) -> Sources:
    """Returns the sources of the images of all frames of episodes.

    Args:
      root: folder of the dataset.
      description: dataset.json.
      records: of D episodes.
      env: `sim.env.Env` of the dataset's scene, with the cameras.

    Raises:
      errors.UsageError: the scene is not the recorded one.
    """
    if schema.model_hash(env.scene) != description["model"]:
        raise errors.UsageError(
            "dataset",
            "images, or the scene of this version",
            f"another version of {description['scene']['task']}",
            "collect it again",
        )
    starts = _start_program(env.reset)(_keys(description, records), schema.trocars_of(records))
    folders = (root / "episodes" / record["key"] for record in records)
    joints = [np.load(folder / "qpos.npy", allow_pickle=False) for folder in folders]
    return Sources(np.concatenate(joints), starts)


def images(
    root: Path, description: Mapping[str, Any], records: Sequence[Mapping[str, Any]], env: Env
) -> dict[str, DrawnImages]:
    """Returns the images of all frames of episodes by camera, none of them drawn yet.

    The arguments are those of `sources`; the environment's images have their size.
    """
    return images_of(sources(root, description, records, env), records, env)


def images_of(
    found: Sources, records: Sequence[Mapping[str, Any]], env: Env
) -> dict[str, DrawnImages]:
    """Returns `images` from their sources."""
    lengths = [record["length"] for record in records]
    episode = np.repeat(np.arange(len(records), dtype=np.int32), lengths)

    return {
        camera: DrawnImages(
            functools.partial(_draw_program(env.draw, camera), found.episodes),
            found.qpos,
            episode,
            size,
        )
        for camera, size in image_sizes(env).items()
    }


def precompile(env: Env, demos: int) -> dict[str, Any]:
    """Compiles, in the background, the programs that draw the images of so many episodes.

    Returns:
      the shape of a batch of images by camera.
    """
    from starjax.sim.env import without_images

    frame = programs.frame(without_images(env), episodes.DEMONSTRATION)
    keys = jax.eval_shape(lambda: jax.random.split(jax.random.key(0), demos))
    trocar = Trocar(*[jax.ShapeDtypeStruct((demos, len(env.p_world_ref)), np.float32)] * 3)
    starts = _start_program(env.reset).prepare(keys, trocar)
    rows = batch_size()
    qpos = jax.ShapeDtypeStruct((rows, *frame["qpos"].shape), np.float32)
    episode = jax.ShapeDtypeStruct((rows,), np.int32)
    return {
        camera: _draw_program(env.draw, camera).prepare(starts, qpos, episode)
        for camera in image_sizes(env)
    }


@functools.lru_cache(maxsize=4)
def _start_program(reset: Callable[..., Any]) -> Program:
    """Returns the program from keys and trocars `[D]` to `Sources.episodes`."""

    def draw_start(key: jax.Array, trocar: Trocar) -> ImageSource:
        state = reset(key, EnvParams(trocar))
        still = jnp.zeros(0)  # replaced by each frame's
        return ImageSource(still, state.trocar.p_world_trocar, state.layout, state.cameras)

    return Program(jax.vmap(draw_start))


@functools.lru_cache(maxsize=8)
def _draw_program(draw: Callable[..., Any], camera: str) -> Program:
    """Returns the program from `Sources.episodes`, qpos and episodes `[B]` to images."""

    # Episodes are an argument: as constants they would make a program of its own for each seed.
    def draw_batch(episodes: Any, qpos: jax.Array, episode: jax.Array) -> jax.Array:
        source = jax.tree.map(lambda leaf: leaf[episode], episodes)
        return jax.vmap(draw)(source._replace(qpos=qpos))[camera].rgb

    return Program(draw_batch)


def _keys(description: Mapping[str, Any], records: Sequence[Mapping[str, Any]]) -> jax.Array:
    """Returns the environment keys `[D]` of trials, the first halves of `schema.seed_rule`'s."""
    key = jax.random.key(description["seed"])
    of_dataset = jax.random.fold_in(key, schema.stream(description))

    # The key is an argument: as a constant it would make a program of its own for each seed.
    def one(of_dataset: jax.Array, trocar: jax.Array, trial: jax.Array) -> jax.Array:
        key = jax.random.fold_in(jax.random.fold_in(of_dataset, trocar), trial)
        return jax.random.split(key)[0]

    numbers = np.array([(record["trocar"], record["trial"]) for record in records], np.int32)
    return jax.jit(jax.vmap(one, in_axes=(None, 0, 0)))(of_dataset, *numbers.T)


def batch_size() -> int:
    """Returns the number of images per call on this backend."""
    return CPU_BATCH if jax.default_backend() == "cpu" else GPU_BATCH


def _padded(rows: np.ndarray, count: int) -> np.ndarray:
    return np.concatenate([rows, np.repeat(rows[-1:], count - len(rows))])
