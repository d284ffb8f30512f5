"""A dataset's episodes on the page one by one, played, stepped or dragged through."""

import functools
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import mujoco
import numpy as np

from starjax import rcm
from starjax.addons.viewer import frame as frames
from starjax.addons.viewer import page
from starjax.addons.viewer.frame import Frame
from starjax.addons.viewer.plots import Plots
from starjax.addons.viewer.stage import Stage, aim
from starjax.core import errors
from starjax.core.types import Pose
from starjax.data import redraw, schema, store
from starjax.sim import registries, scene
from starjax.sim.names import SceneNames
from starjax.sim.rollouts import episodes, trial_key

if TYPE_CHECKING:  # for annotations alone
    import viser


class RecordedDataset(NamedTuple):
    """A folder of demonstrations.

    Attributes:
      root: the folder.
      description: dataset.json in the terms of schema 2.
      names: the scene's names.
      model: the scene's C model.
      keys: episodes with arrays, in order.
      drawn: images of all their frames, None if they were recorded or cannot be drawn.
      first: `[D + 1]` each episode's first frame there.
    """

    root: Path
    description: dict[str, Any]
    names: SceneNames
    model: mujoco.MjModel
    keys: Sequence[str]
    drawn: redraw.DrawnImages | None
    first: np.ndarray


class Recordings(NamedTuple):
    """Recorded episodes of a scene.

    Attributes:
      names: the scene's names.
      model: its C model.
      hz: control steps per second.
      keys: names of the episodes, in order.
      read: name -> Recording; raises `store.DamagedEpisode`.
    """

    names: SceneNames
    model: mujoco.MjModel
    hz: float
    keys: Sequence[str]
    read: Callable[[str], "Recording"]


class Recording(NamedTuple):
    """A recorded episode.

    Attributes:
      frames: frames of its control steps.
      images: `[T, h, w, 3]` uint8 of the first camera, or None.
      outcome: `success` or `failed`.
    """

    frames: list[Frame]
    images: np.ndarray | None
    outcome: str


def open_dataset(root: Path, image_size: int = 256) -> RecordedDataset:
    """Reads the description of a dataset.

    Args:
      root: the folder.
      image_size: pixels per side of images that were not recorded, which are drawn.

    Raises:
      errors.UsageError: the folder has no episode, or a part of its scene is unknown here.
    """
    description = store.read_description(root)
    spec = description["scene"]
    names = SceneNames(spec["task"], *(tuple(spec[part]) for part in ("arms", "tools", "cameras")))
    records = [store.verify(root, key, arrays=False) for key in store.keys(root)]
    records = [record for record in records if record["files"]]
    keys = [record["key"] for record in records]
    if not keys:
        raise errors.UsageError("--dataset", "a folder with episodes", root)
    errors.choice("task of the dataset", names.task, registries.tasks.names())
    camera, drawn = next(iter(names.cameras), ""), None
    is_recorded = f"{episodes.IMAGE}{camera}" in description["features"]
    if camera and not is_recorded and redraw.is_possible(description):
        env = redraw.scene_env(description, image_size)
        drawn = redraw.images(root, description, records, env)[camera]
    first = np.cumsum([0, *(record["length"] for record in records)])
    model = scene.compose(names)
    return RecordedDataset(root, description, names, model, keys, drawn, first)


def read(dataset: RecordedDataset, key: str) -> Recording:
    """Reads an episode and checks every byte of it.

    Raises:
      store.DamagedEpisode: naming the file.
    """
    record = store.verify(dataset.root, key)
    folder = dataset.root / "episodes" / key

    def field(name: str) -> np.ndarray:
        return np.load(folder / f"{name}.npy", allow_pickle=False)

    p_world_trocar = rcm.trocar_position(
        schema.trocars_of([record]), np.array(dataset.description["p_world_ref"], np.float32)
    )
    steps = frames.from_arrays(
        field("qpos"),
        np.asarray(p_world_trocar)[0],
        field("p"),
        field("rcm_error"),
        frames.colours(dataset.names, dataset.model, record["labels"]),
        _still(dataset, record),
    )
    camera = f"{episodes.IMAGE}{next(iter(dataset.names.cameras), '')}"
    images = field(camera) if f"{camera}.npy" in record["files"] else None
    if dataset.drawn is not None:
        episode = dataset.keys.index(key)
        images = dataset.drawn[np.arange(dataset.first[episode], dataset.first[episode + 1])]
    last = steps[-1]._replace(done=True, success=record["success"], invalid=record["invalid"])
    return Recording([*steps[:-1], last], images, "success" if record["success"] else "failed")


def _still(dataset: RecordedDataset, record: dict[str, Any]) -> Pose | None:
    """Returns the bodies at rest of an episode, None of one whose draws are unknown."""
    if not redraw.is_possible(dataset.description):
        return None
    seed, stream = dataset.description["seed"], schema.stream(dataset.description)
    trial = record["trocar"], record["trial"]
    return trial_key.bodies_at_rest(dataset.names, seed, *trial, stream)


def of_dataset(dataset: RecordedDataset) -> Recordings:
    """Returns the episodes of a dataset."""
    hz = float(dataset.description["control_hz"])
    return Recordings(
        dataset.names, dataset.model, hz, dataset.keys, functools.partial(read, dataset)
    )


class EpisodePlayer:
    """The episode on the page.

    Attributes:
      hz: control steps per second.
      key: its name.
      t: the displayed control step.
    """

    def __init__(self, server: "viser.ViserServer", recordings: Recordings):
        self._server, self._recordings = server, recordings
        self.hz = recordings.hz
        self._status = page.Status(server.gui)
        self._stage = Stage(server.scene, recordings.model)
        aim(server, 1)
        _, tab = page.side_panel(server.gui, "Recorded")
        with tab:
            self._plots = Plots(server.gui, ["recorded"], self.hz)
            cameras = recordings.names.cameras[:1]
            self._pictures = page.Pictures(server.gui, [f"{camera} sees" for camera in cameras])

    @property
    def last(self) -> int:
        """Index of the last control step."""
        return len(self._recording.frames) - 1

    def open(self, key: str) -> None:
        """Reads another episode; if it is damaged, notifies the user and keeps the present one."""
        try:
            self._recording = self._recordings.read(key)
        except store.DamagedEpisode as error:
            page.notify(self._server, "Damaged", str(error), is_error=True)
            if not hasattr(self, "_recording"):
                raise
            return
        self.key = key
        self.show(0)

    def show(self, t: int, is_jump: bool = True) -> None:
        """Shows a control step; after a jump, draws the plots anew."""
        self.t, frame = t, self._recording.frames[t]
        if is_jump:
            self._plots.clear()
            self._stage.clear()
            for before in self._recording.frames[:t]:
                self._plots.add([before])
        with self._server.atomic():
            self._stage.show(frame)
        self._plots.add([frame])
        if is_jump or t == self.last or t % page.REDRAW_STEPS == 0:
            self._plots.draw()
            if self._recording.images is not None:
                self._pictures.show([self._recording.images[t]])
            self._status.set(
                f"Episode {self.key}, {self._recording.outcome}\n"
                f"{t / self.hz:.1f} of {self.last / self.hz:.1f} s, "
                f"RCM error {frames.rcm_error_mm(frame):.2f} mm"
            )


def run(
    server: "viser.ViserServer", recordings: Recordings, should_stop: Callable[[], bool]
) -> str:
    """Shows episodes until `should_stop()`; returns a summary line."""
    gui, requests, keys = server.gui, page.UiRequests(), list(recordings.keys)
    episode = EpisodePlayer(server, recordings)
    player = page.Player(gui, requests)
    choices = page.Choices(gui, requests, episode=(keys, keys[0]))
    slider = gui.add_slider("Time (%)", 0.0, 100.0, 0.1, 0.0)
    # The loop moves the slider too: only a client's move is a request.
    slider.on_update(lambda event: requests.add("drag") if event.client is not None else None)
    episode.open(keys[0])
    clock, played = page.Clock(episode.hz), {keys[0]}
    while not should_stop():
        requested = requests.pop()
        if "next" in requested:
            choices.offer("episode", keys, keys[(keys.index(episode.key) + 1) % len(keys)])
        if choices["episode"] != episode.key:
            episode.open(choices["episode"])
            choices.offer("episode", keys, episode.key)
            played.add(episode.key)
        elif "again" in requested:
            episode.show(0)
        elif "drag" in requested:
            episode.show(round(float(slider.value) / 100.0 * episode.last))
        elif "step" in requested or (player.is_playing and episode.t < episode.last):
            if player.is_playing:
                clock.wait(player.speed)
            episode.show(min(episode.t + 1, episode.last), is_jump=False)
            if episode.t % page.REDRAW_STEPS == 0:
                slider.value = 100.0 * episode.t / max(episode.last, 1)
        else:
            clock.pause()
            time.sleep(page.PAUSED_S)
    return f"{len(played)} of {len(keys)} episodes shown"
