"""Teleoperation: an operator demonstrates on the page in real time and keeps good episodes.

With a policy at work, a key passes control to the hand and back.
"""

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import numpy as np

from starjax.addons.viewer import goal_distance, page, shared_control
from starjax.addons.viewer.devices import Device
from starjax.addons.viewer.frame import outcome, rcm_error_mm
from starjax.addons.viewer.recorder import Recorder, Steering
from starjax.addons.viewer.selection import trocar_names
from starjax.addons.viewer.shared_control import SharedControl
from starjax.addons.viewer.stage import Stage, aim
from starjax.addons.viewer.teleop_target import Pilot
from starjax.addons.viewer.view import REST_S
from starjax.sim.rollouts import episodes
from starjax.sim.state import Env

if TYPE_CHECKING:  # for annotations alone
    import viser

_PICTURE_WIDTH = 480  # pixels
_OVER = object()  # for a replay


class OperatorEpisode:
    """The present trial: its state, and its view on the page.

    Attributes:
      control: its state, and the hand or the policy that acts.
      frame: the present frame.
      end: outcome, empty while the trial runs.
      distances: name of a point of the task -> mm to the nearest tip.
    """

    def __init__(self, server: "viser.ViserServer", steering: Steering, pilot: Pilot, seed: int):
        self._steering, self.control = steering, SharedControl(steering, pilot, seed)
        env = steering.env
        self._limit = round(env.task.time_limit_s * env.control_hz)
        self._stage = Stage(server.scene, env.scene.mj_model)
        aim(server, 1)
        _, tab = page.side_panel(server.gui, "Camera", _PICTURE_WIDTH)
        with tab:
            self._picture = page.Pictures(server.gui, [env.names.cameras[0]], _PICTURE_WIDTH)
        self._distances = goal_distance.make(env)

    def begin(self, configuration: int, trial: int) -> None:
        """Sets up a trial that waits for the operator."""
        self.end = ""
        self._rest_steps = round(REST_S * self._steering.env.control_hz)
        self.frame = self.control.begin(configuration, trial)
        self._stage.clear()
        self._draw(with_image=True)

    def advance(self, recorder: Recorder) -> None:
        """Runs one control step; records from the first motion to the end of the trial."""
        hand = self.control.read()
        if self.end or self.control.is_waiting:
            return
        self.frame = self.control.step(hand, recorder)
        self.end = outcome(self.frame, recorder.length >= self._limit)
        self._draw(with_image=bool(self.end) or recorder.length % page.REDRAW_STEPS == 0)

    def rest(self, recorder: Recorder) -> bool:
        """Counts a step of the pause after a trial that the policy did alone; True at its end."""
        if not self.control.is_shared or not self.end or recorder.is_worth_saving:
            return False
        self._rest_steps -= 1
        return self._rest_steps <= 0

    def replay(self, recorder: Recorder) -> Iterator[None]:
        """Shows the recorded control steps one by one, then the present one again."""
        self._stage.clear()
        camera = f"{episodes.IMAGE}{self._steering.env.names.cameras[0]}"
        for i, moment in enumerate(list(recorder.moments)):
            self._stage.show(moment.frame)
            if camera in moment.fields and i % page.REDRAW_STEPS == 0:
                self._picture.show([moment.fields[camera][0]])
            yield
        self._draw(with_image=True)

    def _draw(self, with_image: bool) -> None:
        self._stage.show(self.frame)
        if with_image:
            images = self._steering.look(self.control.state)
            self._picture.show([np.asarray(next(iter(images.values())))])
            self.distances = self._distances(self.control.state.env)


def run(
    server: "viser.ViserServer",
    steering: Steering,
    recorder: Recorder,
    should_stop: Callable[[], bool],
    *,
    device: Device | None = None,
    trocar: int = 0,
    seed: int = 0,
) -> str:
    """Lets an operator demonstrate until `should_stop()`; returns a summary line."""
    env, gui, requests = steering.env, server.gui, page.UiRequests()
    status = page.Status(gui, "Compiling\nAbout a minute the first time, seconds later.")
    gui.add_markdown(f"Strict success: {env.task.text.strict}.")
    hint = "Enter, Backspace, R: shows the episode before it is saved"
    buttons = gui.add_button_group("", ("Save", "Discard", "Replay"), hint=hint)
    buttons.on_click(lambda event: requests.add(event.target.value.lower()))
    shared_control.add_keys(gui, requests, steering.policy is not None)
    page.add_command(gui, "Replay the episode", "R", lambda: requests.add("replay"))
    names = trocar_names(env.task.name)
    choices = page.Choices(gui, requests, trocar=(names, names[trocar]))
    pilot = shared_control.add_pilot(server, env, device)
    steering.compile()  # not after the operator's first motion
    episode = OperatorEpisode(server, steering, pilot, seed)

    def begin(least: int = 0) -> None:
        recorder.discard()
        configuration = int(choices["trocar"].split()[0])
        episode.begin(configuration, max(recorder.next_trial(configuration), least))

    begin()
    clock, replay = page.Clock(env.control_hz), iter(())
    while not should_stop():
        requested = requests.pop()
        if "pass" in requested:
            episode.control.pass_control()
        if "save" in requested and recorder.is_worth_saving:
            if shared_control.save(server, recorder, episode.control):
                begin()
            clock.pause()
        elif requested & {"discard", "choice"}:
            begin(0 if "choice" in requested else episode.control.trial)
            clock.pause()
        elif episode.rest(recorder):
            begin(episode.control.trial + 1)
            clock.pause()
        if requested & {"save", "discard", "choice"}:
            replay = iter(())
        elif "replay" in requested:
            replay = episode.replay(recorder)
        clock.wait()
        is_replay = next(replay, _OVER) is not _OVER
        if not is_replay:
            episode.advance(recorder)
        if clock.steps % page.REDRAW_STEPS == 0:
            status.set(_status(env, episode, recorder, clock, is_replay))
    saved = f"{recorder.saved} episodes saved, {recorder.kept} of them successful"
    return f"{saved}; {clock.missed} of {clock.steps} control steps late"


def _status(
    env: Env, episode: OperatorEpisode, recorder: Recorder, clock: page.Clock, is_replay: bool
) -> str:
    """Returns the status lines of the page."""
    frame = episode.frame
    tips = "; ".join(" ".join(f"{1e3 * x:.1f}" for x in p) for p in frame.p_world_tip)
    progress = episode.end or env.task.stages[int(frame.stage)]
    if not recorder.length:
        progress = "waits for your hand"
    if episode.control.is_shared:
        progress += ", your hand acts" if episode.control.hand_acts else ", the policy acts"
    progress = "replay" if is_replay else progress
    goals = ", ".join(f"to {name} {mm:.1f}" for name, mm in episode.distances.items())
    return (
        f"{progress}, {recorder.length / env.control_hz:.1f} s recorded\n"
        f"distance {goals} mm\n"
        f"tip {tips} mm, RCM error {rcm_error_mm(frame):.2f} mm\n"
        f"{recorder.saved} episodes saved, {recorder.kept} of them successful; "
        f"{clock.missed} steps late"
    )
