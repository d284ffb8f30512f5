"""The page in the browser: its server, clock, buttons, side panel and status lines.

Callbacks of the page run in threads of their own: buttons only leave a request, which the loop of
the view takes up.
"""

import contextlib
import html
import io
import queue
import time
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.ndimage

from starjax.addons.viewer import front
from starjax.core import errors

if TYPE_CHECKING:  # for annotations alone
    import viser

HOST = "127.0.0.1"
PORT = 8080
ANY = 0  # a port that the system chooses
NOBODY = "nobody"
REDRAW_STEPS = 3  # control steps between two pictures, plots and status lines
PAUSED_S = 0.02  # between two polls of a paused page
LATE = 1.0  # periods after which a step counts as missed
_TEAL = (0, 105, 92)  # legible on light and on dark paper
_PANEL_WIDTH = 300  # pixels
_PLAY, _PAUSE = "Play", "Pause"
_NOTE_S = 5.0  # time that a note stays
_STATUS_STYLE = "font-size:0.85em;line-height:1.5;padding:0 0.9em 0.4em"


@contextlib.contextmanager
def serve(
    port: int = PORT, label: str = "starjax", host: str = HOST, names: Sequence[str] = ()
) -> Iterator[Any]:
    """Yields an empty `viser.ViserServer` in the house's colours, by default for this machine only.

    Args:
      port: of the page.
      label: of the page.
      host: address that it listens at.
      names: further names under which browsers may open it, see `own_pages.refusal`.

    Raises:
      errors.UsageError: the port is taken or not permitted.
    """
    import viser

    from starjax.addons.viewer import own_pages

    # viser prints a banner, and lets pages of other origins connect.
    with contextlib.redirect_stdout(io.StringIO()), own_pages.only(names, front.adapt):
        server = viser.ViserServer(host=host, port=port, label=label, verbose=False)
    try:
        # viser silently takes the next free port, which the user would not open.
        if port not in (ANY, server.get_port()):
            hint = "is another viewer open? --port 0 takes a free one"
            raise errors.UsageError("port", "a free port", port, hint)
        server.gui.configure_theme(
            brand_color=_TEAL, show_logo=False, show_share_button=False, control_width="medium"
        )
        server.gui.main_panel.dock_right()  # no handle of the scene lies under it
        yield server
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()


def address(server: "viser.ViserServer") -> str:
    """Returns the address to open in a browser."""
    return f"http://{server.get_host()}:{server.get_port()}"


class Clock:
    """Pacing of a loop in real time.

    Attributes:
      steps: paced control steps.
      missed: steps that began a period or more after they were due.
    """

    def __init__(
        self,
        hz: float,
        now: Callable[[], float] = time.perf_counter,
        sleep: Callable[[float], None] = time.sleep,
    ):
        self._hz, self._now, self._sleep = hz, now, sleep
        self._due: float | None = None
        self.steps = self.missed = 0

    def wait(self, speed: float = 1.0) -> None:
        """Waits until the next step is due; after a missed step, counts time from now."""
        now, period = self._now(), 1.0 / (self._hz * speed)
        if self._due is None:
            self._due = now
        late = now - self._due
        if late < 0:
            self._sleep(-late)
        self.steps += 1
        if late >= LATE * period:
            self.missed += 1
            self._due = now
        self._due += period

    def pause(self) -> None:
        """Makes the next step due immediately."""
        self._due = None


class UiRequests:
    """Names of the requests that the page's buttons made since the last `pop`."""

    def __init__(self) -> None:
        self._queue: queue.SimpleQueue[str] = queue.SimpleQueue()

    def add(self, name: str) -> None:
        """Adds a request; safe in any thread."""
        self._queue.put(name)

    def pop(self) -> set[str]:
        """Returns the pending requests and clears them."""
        names = set()
        while not self._queue.empty():
            names.add(self._queue.get())
        return names


def add_command(
    gui: Any, label: str, hotkey: str, call: Callable[[], None], description: str = ""
) -> None:
    """Binds a hotkey, which the page lists under its label."""
    command = gui.add_command(label, description=description or None, hotkey=hotkey)
    command.on_trigger(lambda _: call())


class Player:
    """Buttons to play, pause, step and repeat, with hotkeys; requests `step`, `again`, `next`.

    Attributes:
      is_playing: true unless paused.
    """

    def __init__(self, gui: "viser.GuiApi", requests: UiRequests):
        self.is_playing = True

        def play(is_playing: bool) -> None:
            self.is_playing = is_playing
            buttons.options = (_PAUSE if is_playing else _PLAY, *buttons.options[1:])

        def toggle() -> None:
            play(not self.is_playing)

        def step() -> None:
            play(False)
            requests.add("step")

        keys = {
            _PAUSE: (toggle, "space", "plays, or pauses"),
            "Step": (step, "S", "one control step"),
            "Again": (lambda: requests.add("again"), "A", "the same trial from its start"),
            "Next": (lambda: requests.add("next"), "N", "the next trial"),
        }
        hint = "; ".join(f"{key.capitalize()}: {text}" for _, key, text in keys.values())
        buttons = gui.add_button_group("", tuple(keys), hint=hint)
        self._speed = gui.add_slider("Speed", 0.1, 4.0, 0.1, 1.0)
        calls = {label: call for label, (call, *_) in keys.items()} | {_PLAY: toggle}
        buttons.on_click(lambda event: calls[event.target.value]())
        for label, (call, key, text) in keys.items():
            add_command(gui, "Play or pause" if call is toggle else label, key, call, text)

    @property
    def speed(self) -> float:
        """Playback speed as a multiple of real time."""
        return float(self._speed.value)


class Choices:
    """Dropdowns by name; a change of one requests `choice`."""

    def __init__(
        self, gui: "viser.GuiApi", requests: UiRequests, **options: tuple[Sequence[str], str]
    ):
        self._dropdowns = {}
        for name, (names, value) in options.items():
            label = name.capitalize().replace("_", " ")
            dropdown = gui.add_dropdown(label, tuple(names), initial_value=value)
            dropdown.on_update(lambda _: requests.add("choice"))
            self._dropdowns[name] = dropdown

    def __getitem__(self, name: str) -> str:
        return self._dropdowns[name].value

    def offer(self, name: str, names: Sequence[str], value: str) -> None:
        """Replaces the names of a dropdown and selects one."""
        dropdown = self._dropdowns[name]
        if tuple(dropdown.options) != tuple(names):
            dropdown.options = tuple(names)
        if dropdown.value != value:
            dropdown.value = value


def side_panel(gui: "viser.GuiApi", label: str, width: int = _PANEL_WIDTH) -> tuple[Any, Any]:
    """Adds a panel of so many pixels at the left; returns it and its tab, to fill in a `with`."""
    panel = gui.add_panel()
    panel.dock_left()
    panel.set_width(width)
    return panel, panel.add_tab(label)


class Pictures:
    """Camera images, one per label, enlarged to a width in pixels."""

    def __init__(self, gui: "viser.GuiApi", labels: Sequence[str], width: int = _PANEL_WIDTH):
        blank = np.zeros((2, 2, 3), np.uint8)
        self._images = [gui.add_image(blank, label=label) for label in labels]
        self._width = width

    def show(self, images: Sequence[np.ndarray]) -> None:
        """Sends images `[h, w, 3]` uint8."""
        for handle, image in zip(self._images, images, strict=True):
            handle.image = enlarged(image, self._width)


def enlarged(image: np.ndarray, width: int) -> np.ndarray:
    """Interpolates an image `[h, w, 3]` uint8 linearly to a width, if it is narrower."""
    factor = width / image.shape[1]
    if factor <= 1.0:
        return image
    return np.asarray(scipy.ndimage.zoom(image, (factor, factor, 1.0), order=1))


class Status:
    """Lines of status. They are HTML, because the page is slow to set Markdown."""

    def __init__(self, gui: "viser.GuiApi", text: str = ""):
        self._handle, self._text = gui.add_html(_as_html(text)), text

    def set(self, text: str) -> None:
        """Shows a text, the first line of each paragraph in bold; sends it only if it is new."""
        if text != self._text:
            self._text, self._handle.content = text, _as_html(text)


def notify(server: Any, title: str, text: str, is_error: bool = False) -> None:
    """Shows a note on every open page; an error stays until the user closes it."""
    options = {"color": "red"} if is_error else {"auto_close_seconds": _NOTE_S}
    for client in server.get_clients().values():
        client.add_notification(title, text, **options)


def _as_html(text: str) -> str:
    paragraphs = (paragraph.split("\n") for paragraph in text.split("\n\n"))
    return "".join(
        f'<div style="{_STATUS_STYLE}"><b>{html.escape(first)}</b>'
        f"{''.join(f'<br>{html.escape(line)}' for line in rest)}</div>"
        for first, *rest in paragraphs
    )
