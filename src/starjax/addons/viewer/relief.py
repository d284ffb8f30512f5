"""The live view of a policy that the operator can relieve, and whose takeovers are saved."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from starjax.addons.viewer import page, shared_control
from starjax.addons.viewer.frame import Frame
from starjax.addons.viewer.recorder import Recorder, Steering
from starjax.addons.viewer.selection import trocar_names
from starjax.addons.viewer.shared_control import SharedControl
from starjax.addons.viewer.simulation import LiveState, Simulation
from starjax.addons.viewer.view import Rollouts

if TYPE_CHECKING:  # for annotations alone
    import viser


class FixedTrocars:
    """The trocars of the task's configurations, which stay: an intervention belongs to one."""

    def place(self, p_world_trocar: np.ndarray) -> None:
        """Sets the trocars `[A, 3]` m of a trial's start."""
        self._p = p_world_trocar

    def own(self) -> None:
        """Returns None: there are no others."""

    def target(self) -> np.ndarray:
        """Returns the trocars `[A, 3]` m."""
        return self._p

    def release(self) -> None:
        """Does nothing."""

    def remove(self) -> None:
        """Does nothing."""


def run(
    server: "viser.ViserServer",
    label: str,
    steering: Steering,
    recorder: Recorder,
    should_stop: Callable[[], bool],
    *,
    trocar: int = 0,
    seed: int = 0,
) -> str:
    """Shows a policy at work, and records its operator, until `should_stop()`.

    Args:
      server: the page's.
      label: name of the policy.
      steering: of an environment and the policy.
      recorder: of the same.
      should_stop: True ends the view.
      trocar: index of the task's trocar configuration.
      seed: random seed of the trials, those of demonstrations.

    Returns:
      a summary line.
    """
    env, gui, requests = steering.env, server.gui, page.UiRequests()
    status = page.Status(gui, "Compiling\nAbout a minute the first time, seconds later.")
    player, who = page.Player(gui, requests), page.Status(gui)
    shared_control.add_keys(gui, requests, is_shared=True)
    names = trocar_names(env.task.name)
    choices = page.Choices(gui, requests, trocar=(names, names[trocar]))
    control = SharedControl(steering, shared_control.add_pilot(server, env), seed)
    steering.compile()  # before anything is recorded
    shown = _simulation(f"{label} and your hand", steering, control, recorder)
    rollouts = Rollouts(server, [shown], status, trocars=FixedTrocars(), is_compiled=True)

    def begin(least: int) -> None:
        configuration = int(choices["trocar"].split()[0])
        trial = max(recorder.next_trial(configuration), least)
        rollouts.begin(seed, configuration, trial)

    begin(0)
    clock = page.Clock(rollouts.hz)
    while not should_stop():
        requested = requests.pop()
        if "pass" in requested:
            control.pass_control()
        if "save" in requested and recorder.is_worth_saving:
            if shared_control.save(server, recorder, control):
                begin(0)
            clock.pause()
        elif requested & {"discard", "again", "next", "choice"}:
            begin(0 if "choice" in requested else control.trial + ("next" in requested))
            clock.pause()
        elif "step" in requested or player.is_playing:
            if player.is_playing:
                clock.wait(player.speed)
            if rollouts.advance() and not recorder.is_worth_saving:
                requests.add("next")
        else:
            clock.pause()
            rollouts.idle()
        who.set(_status(control, recorder))
    saved = f"{recorder.saved} episodes saved, {recorder.kept} of them successful"
    return f"{rollouts.summary()}; {saved}"


def _simulation(
    label: str, steering: Steering, control: SharedControl, recorder: Recorder
) -> Simulation:
    """Makes the closed loop of the policy and the hand, which records itself."""

    def start(seed: int, configuration: int, trial: int, _: Any) -> tuple[LiveState, Frame]:
        recorder.discard()
        first = control.begin(configuration, trial)
        return control.state, first

    def step(_: LiveState, target: np.ndarray) -> tuple[LiveState, Frame]:
        after = control.step(control.read(), recorder)
        return control.state, after

    assert steering.policy is not None
    return Simulation(label, steering.env, start, step, steering.look, steering.policy.monitor)


def _status(control: SharedControl, recorder: Recorder) -> str:
    """Returns the status lines about the hand."""
    acts = "your hand acts" if control.hand_acts else "the policy acts"
    keys = "; Enter saves, Backspace discards" if recorder.is_worth_saving else ""
    return f"{acts}{keys}\n{recorder.saved} episodes saved, {recorder.kept} of them successful"
