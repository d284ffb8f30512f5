"""Rollouts side by side on the page: the same trial, through the same trocars, by one or two."""

import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from starjax.viewer import panel
from starjax.viewer.frame import outcome
from starjax.viewer.handles import TrocarHandles
from starjax.viewer.plots import Plots
from starjax.viewer.simulation import Simulation
from starjax.viewer.stage import Stage, aim
from starjax.viewer.status import Status

_SELDOM = 3  # control steps between two pictures and plots
_REST_S = 1.5  # after an episode, until the next trial
_PAUSED_S = 0.02  # between two looks at the page


class Rollouts:
    """One rollout or two, where they are drawn, and how the trials so far ended.

    Attributes:
      hz: control steps a second. trial: number of the present one.
    """

    def __init__(self, server: Any, simulations: Sequence[Simulation], status: Status):
        self._server, self._simulations, self._status = server, simulations, status
        env, gui = simulations[0].env, server.gui
        self.hz, self._limit = env.control_hz, round(env.task.time_limit_s * env.control_hz)
        labels = [simulation.label for simulation in simulations]
        self._stages = [
            Stage(server.scene, simulation.env.scene.mj_model, i)
            for i, simulation in enumerate(simulations)
        ]
        aim(server, len(simulations))
        self._handles = TrocarHandles(server.scene, env.task)
        self._measured, tab = panel.beside(gui, "Measured")
        with tab:
            self._plots = Plots(gui, labels, self.hz)
            self._pictures = panel.Pictures(gui, labels)
        self._tally = np.zeros((len(simulations), 2), int)  # succeeded, ended

    def begin(self, seed: int, configuration: int, trial: int) -> None:
        """Starts a trial through a configuration of the task's trocars."""
        self.trial, self._rest = trial, round(_REST_S * self.hz)
        begun = [one.start(seed, configuration, trial) for one in self._simulations]
        self._carries, self._frames = map(list, zip(*begun))
        self._ends = [""] * len(begun)
        self._handles.place(self._frames[0].p_world_trocar)
        self._plots.clear()
        for stage in self._stages:
            stage.clear()
        self._draw(rarely=True)

    def advance(self) -> bool:
        """One control step; returns whether all are over, and have been for a while."""
        if all(self._ends):
            self._rest -= 1
            return self._rest <= 0
        wanted = self._handles.wanted()
        for i in [i for i, end in enumerate(self._ends) if not end]:
            self._carries[i], frame = self._simulations[i].step(self._carries[i], wanted)
            self._frames[i], self._ends[i] = frame, outcome(frame, frame.step >= self._limit)
            self._tally[i] += bool(frame.success), bool(self._ends[i])
        self._draw(rarely=all(self._ends) or self._frames[0].step % _SELDOM == 0)
        return False

    def idle(self) -> None:
        """While it is paused."""
        self._handles.wanted()
        time.sleep(_PAUSED_S)

    def said(self) -> str:
        """Success so far."""
        return "; ".join(
            f"{simulation.label}: {won} of {ended} trials succeeded"
            for simulation, (won, ended) in zip(self._simulations, self._tally)
        )

    def remove(self) -> None:
        """Takes all of it off the page."""
        for part in (*self._stages, self._handles, self._measured):
            part.remove()

    def _draw(self, rarely: bool) -> None:
        with self._server.atomic():
            for stage, frame in zip(self._stages, self._frames):
                stage.show(frame)
        self._plots.add(self._frames)
        if rarely:
            self._plots.draw()
            looks = [one.look(c) for one, c in zip(self._simulations, self._carries)]
            self._pictures.show([np.asarray(next(iter(look.values()))) for look in looks])
            self._status.say("\n\n".join(map(self._line, range(len(self._stages)))))

    def _line(self, i: int) -> str:
        """Status of a rollout."""
        frame, (won, ended) = self._frames[i], self._tally[i]
        now = self._ends[i] or self._simulations[i].env.task.stages[int(frame.stage)]
        error = 1e3 * float(np.max(frame.rcm_error))
        return (
            f"{self._simulations[i].label}, trial {self.trial}: "
            f"{frame.step / self.hz:.1f} s, {now}\n"
            f"RCM error {error:.2f} mm; success so far: {won} of {ended}"
        )
