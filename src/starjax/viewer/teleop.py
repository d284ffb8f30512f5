"""Teleoperation: a person demonstrates on the page, in real time, and keeps what went well."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from starjax.runtime import files
from starjax.viewer import hand as hands
from starjax.viewer import view
from starjax.viewer.clock import Clock
from starjax.viewer.devices import Device
from starjax.viewer.frame import Frame, outcome
from starjax.viewer.pilot import Pilot
from starjax.viewer.recorder import Recorder
from starjax.viewer.stage import Stage, aim
from starjax.viewer.status import Status, notify
from starjax.viewer.steering import Steering

_SELDOM = 3  # control steps between two pictures


@dataclasses.dataclass
class Wishes:
    """Buttons pressed since the loop looked last."""

    save: bool = False
    discard: bool = False
    other: bool = False  # trocar

    def taken(self) -> "Wishes":
        """The wishes, which are fulfilled from now on."""
        found = dataclasses.replace(self)
        self.save = self.discard = self.other = False
        return found


class Episode:
    """The trial under way: its state, and where it is drawn."""

    def __init__(self, server: Any, steering: Steering, pilot: Pilot, seed: int):
        self._steering, self._pilot, self._seed = steering, pilot, seed
        env = steering.env
        self.limit = round(env.task.time_limit_s * env.control_hz)
        self._stage = Stage(server.scene, env.scene.mj_model)
        aim(server, 1)
        self._picture = server.gui.add_image(np.zeros((2, 2, 3), np.uint8), label="Camera")

    def begin(self, configuration: int, trial: int) -> None:
        """Sets up a trial, which waits for the hand."""
        self.configuration, self.trial, self.end = configuration, trial, ""
        begun = self._steering.start(self._seed, configuration, trial)
        self._state, self.frame, actions, openings = begun
        slots = self._steering.env.task.slots
        bounds = [hands.bounds(slot, a[1:]) for slot, a in zip(slots, actions, strict=True)]
        self._pilot.rest(actions, openings, bounds)
        self._stage.clear()
        self.draw(rarely=True)

    def advance(self, recorder: Recorder) -> None:
        """One control step, recorded from the hand's first motion to the end of the trial."""
        action, opening = self._pilot.read(1.0 / self._steering.env.control_hz)
        if self.end or not self._pilot.has_moved:
            return
        self._state, moment = self._steering.step(self._state, action, opening)
        self.frame = moment.frame
        recorder.add(moment)
        self.end = outcome(self.frame, recorder.length >= self.limit)
        self.draw(rarely=bool(self.end) or recorder.length % _SELDOM == 0)

    def draw(self, rarely: bool) -> None:
        """Shows the moment; the picture `rarely`."""
        self._stage.show(self.frame)
        if rarely:
            image = np.asarray(next(iter(self._steering.look(self._state).values())))
            self._picture.image = image.repeat(2, axis=0).repeat(2, axis=1)


def run(
    server: Any,
    steering: Steering,
    recorder: Recorder,
    should_stop: Callable[[], bool],
    *,
    device: Device | None = None,
    trocar: int = 0,
    seed: int = 0,
) -> str:
    """Lets a person demonstrate until `should_stop()`; returns a line about what was kept."""
    env, gui, wishes = steering.env, server.gui, Wishes()
    status = Status(gui, "Compiling\nAbout a minute the first time, seconds later.")
    gui.add_markdown(f"Strict success: {env.task.text.strict}.")
    buttons = gui.add_button_group("", ("Save", "Discard"), hint="Enter, Backspace")
    buttons.on_click(lambda event: setattr(wishes, event.target.value.lower(), True))
    save = gui.add_command("Save the episode", hotkey="enter")
    save.on_trigger(lambda _: setattr(wishes, "save", True))
    discard = gui.add_command("Discard the episode", hotkey="backspace")
    discard.on_trigger(lambda _: setattr(wishes, "discard", True))
    names = view.trocar_names(env.task.name)
    chosen = gui.add_dropdown("Trocar", names, initial_value=names[trocar])
    chosen.on_update(lambda _: setattr(wishes, "other", True))
    pilot = Pilot(server, env.task.arms, axes_of(env), device)
    steering.compile()  # not while a hand waits for the first motion
    episode = Episode(server, steering, pilot, seed)

    def begin() -> None:
        recorder.discard()
        configuration = int(chosen.value.split()[0])
        episode.begin(configuration, recorder.next_trial(configuration))

    begin()
    clock = Clock(env.control_hz)
    while not should_stop():
        wish = wishes.taken()
        if wish.save and recorder.length:
            if _saved(server, recorder, episode):
                begin()
            clock.pause()
        elif wish.discard or wish.other:
            begin()
            clock.pause()
        clock.wait()
        episode.advance(recorder)
        if clock.steps % _SELDOM == 0:
            status.say(_said(env, episode, recorder, clock))
    return f"{recorder.kept} episodes kept; {clock.missed} of {clock.steps} control steps late"


def _saved(server: Any, recorder: Recorder, episode: Episode) -> bool:
    """Saves the episode; tells on the page where it is, or why it is nowhere."""
    try:
        folder = recorder.save(episode.configuration, episode.trial)
    except files.StorageError as error:
        notify(server, "Not saved", str(error), is_bad=True)
        return False
    kind = "" if episode.frame.success else ", which training leaves out"
    notify(server, "Saved", f"{folder}{kind}")
    return True


def _said(env: Any, episode: Episode, recorder: Recorder, clock: Clock) -> str:
    """Status text of the page."""
    frame: Frame = episode.frame
    tips = "; ".join(" ".join(f"{1e3 * x:.1f}" for x in p) for p in frame.p_world_tip)
    now = episode.end or env.task.stages[int(frame.stage)]
    if not recorder.length:
        now = "waits for your hand"
    return (
        f"{now}, {recorder.length / env.control_hz:.1f} s recorded\n"
        f"tip {tips} mm, RCM error {1e3 * float(np.max(frame.rcm_error)):.2f} mm\n"
        f"{recorder.kept} successful episodes kept; {clock.missed} steps late"
    )


def axes_of(env: Any) -> np.ndarray:
    """The world's directions as a person sees them who looks at the first camera's picture."""
    import mujoco

    model = env.scene.mj_model
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)
    return hands.axes_seen(data.cam(env.names.cameras[0]).xmat.reshape(3, 3))
