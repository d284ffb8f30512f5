"""The view of a dataset: its episodes one by one, played, stepped or dragged through."""

import time
from collections.abc import Callable
from typing import Any

from starjax.data import store
from starjax.viewer import panel, recorded
from starjax.viewer.clock import Clock
from starjax.viewer.plots import Plots
from starjax.viewer.stage import Stage, aim
from starjax.viewer.status import Status, notify

_SELDOM = 3  # control steps between two pictures and plots
_PAUSED_S = 0.02  # between two looks at the page


class Episode:
    """The episode on the page.

    Attributes:
      key: its name. t: the control step that is shown.
    """

    def __init__(self, server: Any, dataset: recorded.Dataset):
        self._server, self._dataset = server, dataset
        self.hz = float(dataset.description["control_hz"])
        self._status = Status(server.gui)
        self._stage = Stage(server.scene, dataset.model)
        aim(server, 1)
        _, tab = panel.beside(server.gui, "Recorded")
        with tab:
            self._plots = Plots(server.gui, ["recorded"], self.hz)
            self._pictures = panel.Pictures(server.gui, [dataset.names.cameras[0]])

    @property
    def last(self) -> int:
        """Number of the last control step."""
        return len(self._recording.frames) - 1

    def open(self, key: str) -> None:
        """Reads another one; a damaged one is told of, and what was shown stays."""
        try:
            self._recording = recorded.read(self._dataset, key)
        except store.DamagedEpisode as error:
            notify(self._server, "Damaged", str(error), is_bad=True)
            if not hasattr(self, "_recording"):
                raise
            return
        self.key = key
        self.show(0)

    def show(self, t: int, is_jump: bool = True) -> None:
        """Shows a control step; plots begin anew after a jump."""
        self.t, frame = t, self._recording.frames[t]
        if is_jump:
            self._plots.clear()
            self._stage.clear()
            for before in self._recording.frames[:t]:
                self._plots.add([before])
        with self._server.atomic():
            self._stage.show(frame)
        self._plots.add([frame])
        if is_jump or t == self.last or t % _SELDOM == 0:
            self._plots.draw()
            if self._recording.images is not None:
                self._pictures.show([self._recording.images[t]])
            self._status.say(
                f"Episode {self.key}, {self._recording.outcome}\n"
                f"{t / self.hz:.1f} of {self.last / self.hz:.1f} s, "
                f"RCM error {1e3 * float(frame.rcm_error.max()):.2f} mm"
            )


def run(server: Any, dataset: recorded.Dataset, should_stop: Callable[[], bool]) -> str:
    """Shows episodes until `should_stop()`; returns a line about what was shown."""
    gui, wishes, keys = server.gui, panel.Wishes(), list(dataset.keys)
    episode = Episode(server, dataset)
    player = panel.Player(gui, wishes)
    choices = panel.Choices(gui, wishes, episode=(keys, keys[0]))
    slider = gui.add_slider("Time (%)", 0.0, 100.0, 0.1, 0.0)
    dragged = [False]
    slider.on_update(lambda event: dragged.__setitem__(0, event.client is not None))
    episode.open(keys[0])
    clock, shown = Clock(episode.hz), {keys[0]}
    while not should_stop():
        wish = wishes.taken()
        if wish.following:
            choices.offer("episode", keys, keys[(keys.index(episode.key) + 1) % len(keys)])
        if choices["episode"] != episode.key:
            episode.open(choices["episode"])
            choices.offer("episode", keys, episode.key)
            shown.add(episode.key)
        elif wish.again:
            episode.show(0)
        elif dragged[0]:
            dragged[0] = False
            episode.show(round(float(slider.value) / 100.0 * episode.last))
        elif wish.step or (player.is_playing and episode.t < episode.last):
            if player.is_playing:
                clock.wait(player.speed)
            episode.show(min(episode.t + 1, episode.last), is_jump=False)
            if episode.t % _SELDOM == 0:
                slider.value = 100.0 * episode.t / max(episode.last, 1)
        else:
            clock.pause()
            time.sleep(_PAUSED_S)
    return f"{len(shown)} of {len(keys)} episodes shown"
