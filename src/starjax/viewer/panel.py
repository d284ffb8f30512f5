"""The panel of the view: what is played, how fast, by whom; read by the loop, never waited for."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

NOBODY = "nobody"
_WIDTH = 300  # pixels, of the panel of plots and pictures


@dataclasses.dataclass
class Wishes:
    """Requests since the loop looked last. Buttons only ever set a field."""

    step: bool = False
    again: bool = False
    following: bool = False
    other: bool = False  # scene or actor

    def taken(self) -> "Wishes":
        """The wishes, which are fulfilled from now on."""
        found = dataclasses.replace(self)
        self.step = self.again = self.following = self.other = False
        return found


class Player:
    """Play, pause, step, speed; with hotkeys."""

    def __init__(self, gui: Any, wishes: Wishes):
        self._playing = True

        def toggle() -> None:
            self._playing = not self._playing

        def one() -> None:
            self._playing = False
            wishes.step = True

        keys = {
            "Play": (toggle, "space", "plays, or pauses"),
            "Step": (one, "S", "one control step"),
            "Again": (lambda: setattr(wishes, "again", True), "A", "the same trial from its start"),
            "Next": (lambda: setattr(wishes, "following", True), "N", "the next trial"),
        }
        hint = "; ".join(f"{key.capitalize()}: {what}" for _, key, what in keys.values())
        buttons = gui.add_button_group("", tuple(keys), hint=hint)
        self._speed = gui.add_slider("Speed", 0.1, 4.0, 0.1, 1.0)
        buttons.on_click(lambda event: keys[event.target.value][0]())
        for label, (call, key, what) in keys.items():
            command = gui.add_command(label, description=what, hotkey=key)
            command.on_trigger(lambda _, call=call: call())

    @property
    def is_playing(self) -> bool:
        """Whether time goes on by itself."""
        return self._playing

    @property
    def speed(self) -> float:
        """Times real time."""
        return float(self._speed.value)


class Choices:
    """Who does what, where: dropdowns that ask for another scene."""

    def __init__(self, gui: Any, wishes: Wishes, **options: tuple[Sequence[str], str]):
        self._dropdowns = {}
        for name, (names, value) in options.items():
            dropdown = gui.add_dropdown(name.capitalize(), tuple(names), initial_value=value)
            dropdown.on_update(lambda _: setattr(wishes, "other", True))
            self._dropdowns[name] = dropdown

    def __getitem__(self, name: str) -> str:
        return self._dropdowns[name].value

    def offer(self, name: str, names: Sequence[str], value: str) -> None:
        """Other names to choose from."""
        dropdown = self._dropdowns[name]
        if tuple(dropdown.options) != tuple(names):
            dropdown.options = tuple(names)
        if dropdown.value != value:
            dropdown.value = value


def beside(gui: Any, label: str) -> tuple[Any, Any]:
    """A panel at the left: it, which can be removed, and its tab, to be filled in a `with`."""
    panel = gui.add_panel()
    panel.dock_left()
    panel.set_width(_WIDTH)
    return panel, panel.add_tab(label)


class Pictures:
    """Images of the cameras, one a rollout."""

    def __init__(self, gui: Any, labels: Sequence[str]):
        blank = np.zeros((2, 2, 3), np.uint8)
        self._images = [gui.add_image(blank, label=f"{label} sees") for label in labels]

    def show(self, images: Sequence[np.ndarray]) -> None:
        """Sends them, two pixels for one."""
        for handle, image in zip(self._images, images, strict=True):
            handle.image = image.repeat(2, axis=0).repeat(2, axis=1)
