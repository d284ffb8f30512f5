"""Choices of the live view: task, agents, robot and trocar."""

from typing import TYPE_CHECKING, NamedTuple

from starjax.addons.viewer import page, simulation
from starjax.addons.viewer.simulation import AgentSpec
from starjax.addons.viewer.success_map import SuccessMap
from starjax.sim import registries

if TYPE_CHECKING:  # for annotations alone
    import viser

OWN_ARMS = "their own"
_OWN_TROCAR = "own, as you moved it"


class ViewOptions(NamedTuple):
    """Initial choices of the page.

    Attributes:
      agents: one agent, or two with the same task for a view side by side.
      arm: robot in place of their own, or `OWN_ARMS`.
      trocar: index of the task's trocar configuration.
      seed: seed of the trials.
      sweep: trials that are drawn as dots at their trocars, or None.
      trial: number of the first trial.
    """

    agents: tuple[AgentSpec, ...]
    arm: str = OWN_ARMS
    trocar: int = 0
    seed: int = 0
    sweep: SuccessMap | None = None
    trial: int = 0


class Selection:
    """Task, agents, robot and trocar that the panel's dropdowns select."""

    def __init__(self, gui: "viser.GuiApi", requests: page.UiRequests, options: ViewOptions):
        self._given = {spec.label: spec for spec in options.agents}
        labels = [spec.label for spec in options.agents]
        task = options.agents[0].task
        names, trocars = list(self._agents(task)), trocar_names(task)
        self._choices = page.Choices(
            gui,
            requests,
            task=(registries.tasks.names(), task),
            agent=(names, labels[0]),
            compare_with=((page.NOBODY, *names), [*labels, page.NOBODY][1]),
            arm=((OWN_ARMS, *registries.arms.names()), options.arm),
            trocar=(trocars, trocars[options.trocar]),
        )
        self._before = self._values()
        self._trocar, self._offers_own = options.trocar, False

    @property
    def trocar(self) -> int:
        """Index of the task's trocar configuration, of the last one at the operator's own place."""
        if not self.is_own:
            self._trocar = int(self._choices["trocar"].split()[0])
        return self._trocar

    @property
    def is_own(self) -> bool:
        """True if the dropdown shows the operator's own trocar."""
        return self._choices["trocar"] == _OWN_TROCAR

    def show_trocar(self, is_own: bool) -> None:
        """Shows the operator's own trocar, or the configuration, in the dropdown."""
        if is_own != self._offers_own:
            self._offers_own = is_own
            names = trocar_names(self._choices["task"])
            shown = _OWN_TROCAR if is_own else names[self.trocar]
            self._choices.offer("trocar", [*names, *[_OWN_TROCAR] * is_own], shown)

    @property
    def arms(self) -> tuple[str, ...]:
        """Robots in place of the agents' own."""
        return () if self._choices["arm"] == OWN_ARMS else (self._choices["arm"],)

    def agents(self) -> list[AgentSpec]:
        """Returns the selected agent, or two with the same task."""
        known = self._agents(self._choices["task"])
        labels = [self._choices["agent"], self._choices["compare_with"]]
        return [known[label] for label in labels if label in known]

    def is_changed(self) -> bool:
        """Returns True if another scene or agent was selected since the last call."""
        task = self._choices["task"]
        if task != self._before[0]:
            names, trocars = list(self._agents(task)), trocar_names(task)
            self._choices.offer("agent", names, names[0])
            self._choices.offer("compare_with", (page.NOBODY, *names), page.NOBODY)
            self._choices.offer("trocar", trocars, trocars[0])
            self._trocar, self._offers_own = 0, False
        before, self._before = self._before, self._values()
        return before != self._before

    def _values(self) -> tuple[str, ...]:
        return tuple(self._choices[name] for name in ("task", "agent", "compare_with", "arm"))

    def _agents(self, task: str) -> dict[str, AgentSpec]:
        requested = {label: spec for label, spec in self._given.items() if spec.task == task}
        return requested | {spec.label: spec for spec in simulation.available(task)}


def trocar_names(task: str) -> list[str]:
    """Returns `INDEX (seen)` or `INDEX (unseen)` of each trocar configuration."""
    seen = registries.tasks.get(task).is_seen
    return [f"{i} ({'seen' if is_seen else 'unseen'})" for i, is_seen in enumerate(seen)]
