"""The live view: an agent at work, or two side by side, through trocars that the user can drag."""

import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from starjax.addons.viewer import page, simulation, success_map
from starjax.addons.viewer.episode_alarm import EpisodeAlarm
from starjax.addons.viewer.frame import outcome, rcm_error_mm
from starjax.addons.viewer.plots import Plots
from starjax.addons.viewer.selection import Selection, ViewOptions
from starjax.addons.viewer.simulation import Simulation
from starjax.addons.viewer.stage import Stage, aim
from starjax.addons.viewer.success_map import SuccessMap
from starjax.addons.viewer.trocar_controls import TrocarControls
from starjax.core import errors

if TYPE_CHECKING:  # for annotations alone
    import viser

    from starjax.addons.viewer.relief import FixedTrocars

_COMPILING = "Compiling {}\nAbout a minute the first time, seconds later."
_HAND = "No hand", "starjax view --policy NAME --record DIR lets T pass control to your hand."
REST_S = 1.5  # pause between an episode and the next trial


def run(server: "viser.ViserServer", options: ViewOptions, should_stop: Callable[[], bool]) -> str:
    """Shows rollouts until `should_stop()`; returns a summary line."""
    requests = page.UiRequests()
    status = page.Status(server.gui)
    player = page.Player(server.gui, requests)
    selection = Selection(server.gui, requests, options)
    page.add_command(server.gui, "Pass control", "T", lambda: page.notify(server, *_HAND))
    rollouts = _load(server, selection, status, options.sweep)
    rollouts.begin(options.seed, selection.trocar, options.trial)
    clock = page.Clock(rollouts.hz)
    while not should_stop():
        requested = requests.pop()
        if "choice" in requested:
            is_changed = selection.is_changed()
            if is_changed:
                rollouts.remove()
                rollouts = _load(server, selection, status, options.sweep)
            if is_changed or not selection.is_own:
                clock.pause()
                rollouts.trocars.release()
                rollouts.begin(options.seed, selection.trocar, 0)
        elif requested & {"again", "next"}:
            clock.pause()
            trial = rollouts.trial + ("next" in requested)
            rollouts.begin(options.seed, selection.trocar, trial)
        elif "step" in requested or player.is_playing:
            if player.is_playing:
                clock.wait(player.speed)
            if rollouts.advance():
                requests.add("next")
        else:
            clock.pause()
            rollouts.idle()
        selection.show_trocar(rollouts.trocars.is_own)
    return f"{rollouts.summary()}; {clock.missed} of {clock.steps} control steps late"


class Rollouts:
    """One rollout or two of the same trial on the page, and a tally of the trials so far.

    Attributes:
      hz: control steps per second.
      trial: number of the present trial.
      trocars: their handles and sliders.
    """

    def __init__(
        self,
        server: "viser.ViserServer",
        simulations: Sequence[Simulation],
        status: page.Status,
        sweep: SuccessMap | None = None,
        *,
        trocars: "TrocarControls | FixedTrocars | None" = None,
        is_compiled: bool = False,
    ):
        """Adds them to the page; `trocars` take the place of `TrocarControls`."""
        self._server, self._simulations, self._status = server, simulations, status
        env, gui = simulations[0].env, server.gui
        self.hz, self._limit = env.control_hz, round(env.task.time_limit_s * env.control_hz)
        labels = [simulation.label for simulation in simulations]
        models = [simulation.env.scene.mj_model for simulation in simulations]
        self._stages = [Stage(server.scene, model, i) for i, model in enumerate(models)]
        aim(server, len(simulations))
        self.trocars = trocars or TrocarControls(server, env.task)
        self._map = []
        if sweep and sweep.task == env.task.name:
            self._map += success_map.add(server.scene, sweep)
            self._map += [gui.add_markdown(success_map.LEGEND)]
        self._panel, tab = page.side_panel(gui, "Measured")
        with tab:
            self._plots = Plots(gui, labels, self.hz)
            self._pictures = page.Pictures(gui, [f"{label} sees" for label in labels])
        self._alarms = [EpisodeAlarm(simulation.monitor) for simulation in simulations]
        # Succeeded and ended trials, at the task's trocars and at the operator's own.
        self._tally = np.zeros((len(simulations), 2, 2), int)
        self._is_compiled, self._is_paused = is_compiled, False

    def begin(self, seed: int, configuration: int, trial: int) -> None:
        """Starts a trial through a trocar configuration of the task, or the operator's own."""
        self.trial, self._rest = trial, round(REST_S * self.hz)
        trocar = self.trocars.own()
        starts = [one.start(seed, configuration, trial, trocar) for one in self._simulations]
        self._states, self._frames = map(list, zip(*starts))
        self._outcomes = [""] * len(starts)
        self.trocars.place(self._frames[0].p_world_trocar)
        self._plots.clear()
        for stage in self._stages:
            stage.clear()
        for alarm in self._alarms:
            alarm.reset()
        self._draw(with_images=True)
        if not self._is_compiled:
            self._compile()

    def advance(self) -> bool:
        """Runs one control step; returns True once all have ended and rested."""
        if all(self._outcomes):
            self._rest -= 1
            return self._rest <= 0
        self._is_paused, target = False, self.trocars.target()
        for i in [i for i, end in enumerate(self._outcomes) if not end]:
            self._states[i], frame = self._simulations[i].step(self._states[i], target)
            self._alarms[i].update(self._frames[i], self._states[i])
            self._frames[i], self._outcomes[i] = frame, outcome(frame, frame.step >= self._limit)
            is_own = int(self.trocars.own() is not None)
            self._tally[i, is_own] += bool(frame.success), bool(self._outcomes[i])
        is_due = self._frames[0].step % page.REDRAW_STEPS == 0
        self._draw(with_images=is_due or all(self._outcomes))
        return False

    def idle(self) -> None:
        """Waits while the view is paused; released handles return."""
        self.trocars.target()
        if not self._is_paused:
            self._is_paused = True
            self._show_status()
        time.sleep(page.PAUSED_S)

    def summary(self) -> str:
        """Returns the success so far."""
        return "; ".join(
            f"{simulation.label}: {successes} of {ended} trials succeeded{_at_own(own)}"
            for simulation, ((successes, ended), own) in zip(self._simulations, self._tally)
        )

    def remove(self) -> None:
        """Removes everything from the page."""
        for part in (*self._stages, *self._map, self.trocars, self._panel):
            part.remove()

    def _draw(self, with_images: bool) -> None:
        """Draws the 3D view and, if `with_images`, also plots, pictures and status."""
        with self._server.atomic():
            for stage, frame in zip(self._stages, self._frames):
                stage.show(frame)
        self._plots.add(self._frames)
        if with_images:
            self._plots.draw()
            images = [one.look(state) for one, state in zip(self._simulations, self._states)]
            self._pictures.show([np.asarray(next(iter(image.values()))) for image in images])
            self._show_status()

    def _compile(self) -> None:
        """Compiles the control steps by taking one that is dropped."""
        labels = " and ".join(one.label for one in self._simulations)
        self._status.set(_COMPILING.format(f"the control step of {labels}"))
        for one, state, frame in zip(self._simulations, self._states, self._frames):
            one.step(state, frame.p_world_trocar)
        self._is_compiled = True
        self._show_status()

    def _show_status(self) -> None:
        self._status.set("\n\n".join(map(self._line, range(len(self._stages)))))

    def _line(self, i: int) -> str:
        frame, ((successes, ended), own) = self._frames[i], self._tally[i]
        progress = self._outcomes[i] or self._simulations[i].env.task.stages[int(frame.stage)]
        lines = [
            f"{self._simulations[i].label}, trial {self.trial}{', paused' * self._is_paused}: "
            f"{frame.step / self.hz:.1f} s, {progress}",
            f"RCM error {rcm_error_mm(frame):.2f} mm; success so far: {successes} of {ended}"
            f"{_at_own(own)}",
            self._alarms[i].text,
        ]
        return "\n".join(filter(None, lines))


def _at_own(tally: np.ndarray) -> str:
    """Returns the count of trials at the operator's own trocars, empty without any."""
    return f", at your own trocars {tally[0]} of {tally[1]}" if tally[1] else ""


def _load(
    server: "viser.ViserServer", selection: Selection, status: page.Status, sweep: SuccessMap | None
) -> Rollouts:
    """Loads the selected agents, on their own robots if the selected arm cannot do the task."""
    specs = selection.agents()
    labels = " and ".join(spec.label for spec in specs)
    status.set(_COMPILING.format(labels))
    try:
        loaded = [simulation.load(spec, selection.arms) for spec in specs]
    except errors.UsageError as error:  # an arm without a mount for this task
        page.notify(server, "Not possible", str(error), is_error=True)
        loaded = [simulation.load(spec) for spec in specs]
    return Rollouts(server, loaded, status, sweep)
