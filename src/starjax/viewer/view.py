"""The live view: somebody at work, through trocars that one may drag."""

from collections.abc import Callable
from typing import Any, NamedTuple

from starjax import errors
from starjax.sim import registries
from starjax.viewer import actors, panel
from starjax.viewer.actors import Actor
from starjax.viewer.clock import Clock
from starjax.viewer.side_by_side import Rollouts
from starjax.viewer.status import Status, notify

THEIRS = "their own"  # of arms


class Asked(NamedTuple):
    """Choices that the page begins with.

    Attributes:
      who: one actor, or two of one task for side by side.
      arm: robot instead of theirs, or `THEIRS`.
      trocar: number of the task's configuration. seed: of the trials.
    """

    who: tuple[Actor, ...]
    arm: str = THEIRS
    trocar: int = 0
    seed: int = 0


def run(server: Any, asked: Asked, should_stop: Callable[[], bool]) -> str:
    """Shows rollouts until `should_stop()`; returns a line about what was shown."""
    wishes = panel.Wishes()
    status = Status(server.gui)
    player = panel.Player(server.gui, wishes)
    cast = Cast(server.gui, wishes, asked)
    rollouts = _built(server, cast, status)
    rollouts.begin(asked.seed, cast.trocar, 0)
    clock = Clock(rollouts.hz)
    while not should_stop():
        wish = wishes.taken()
        if wish.other:
            clock.pause()
            if cast.is_changed():
                rollouts.remove()
                rollouts = _built(server, cast, status)
            rollouts.begin(asked.seed, cast.trocar, 0)
        elif wish.again or wish.following:
            clock.pause()
            rollouts.begin(asked.seed, cast.trocar, rollouts.trial + wish.following)
        elif wish.step or player.is_playing:
            if player.is_playing:
                clock.wait(player.speed)
            if rollouts.advance():
                wishes.following = True
        else:
            clock.pause()
            rollouts.idle()
    return f"{rollouts.said()}; {clock.missed} of {clock.steps} control steps late"


class Cast:
    """Who acts in what, as the panel's dropdowns have it."""

    def __init__(self, gui: Any, wishes: panel.Wishes, asked: Asked):
        self._given = {actor.label: actor for actor in asked.who}
        labels = [actor.label for actor in asked.who]
        task = asked.who[0].task
        names = self._names(task)
        trocars = trocar_names(task)
        self._choices = panel.Choices(
            gui,
            wishes,
            task=(registries.tasks.names(), task),
            who=(names, labels[0]),
            beside=((panel.NOBODY, *names), labels[1] if len(labels) > 1 else panel.NOBODY),
            arm=((THEIRS, *registries.arms.names()), asked.arm),
            trocar=(trocars, trocars[asked.trocar]),
        )
        self._before = self._now()

    @property
    def trocar(self) -> int:
        """Number of the task's configuration."""
        return int(self._choices["trocar"].split()[0])

    @property
    def arms(self) -> tuple[str, ...]:
        """Robots instead of the actors' own."""
        return () if self._choices["arm"] == THEIRS else (self._choices["arm"],)

    def actors(self) -> list[Actor]:
        """One, or two of one task."""
        found = self._known(self._choices["task"])
        chosen = [self._choices["who"], self._choices["beside"]]
        return [found[label] for label in chosen if label in found]

    def is_changed(self) -> bool:
        """Whether another scene or actor was chosen than when this was last asked."""
        task = self._choices["task"]
        if task != self._before[0]:
            names, trocars = self._names(task), trocar_names(task)
            self._choices.offer("who", names, names[0])
            self._choices.offer("beside", (panel.NOBODY, *names), panel.NOBODY)
            self._choices.offer("trocar", trocars, trocars[0])
        before, self._before = self._before, self._now()
        return before != self._before

    def _now(self) -> tuple[str, ...]:
        return tuple(self._choices[name] for name in ("task", "who", "beside", "arm"))

    def _known(self, task: str) -> dict[str, Actor]:
        given = {name: actor for name, actor in self._given.items() if actor.task == task}
        return given | {actor.label: actor for actor in actors.known(task)}

    def _names(self, task: str) -> list[str]:
        return list(self._known(task))


def _built(server: Any, cast: Cast, status: Status) -> Rollouts:
    """Compiles what was chosen, or the same without the arm that cannot do it."""
    who = cast.actors()
    labels = " and ".join(actor.label for actor in who)
    status.say(f"Compiling {labels}\nAbout a minute the first time, seconds later.")
    try:
        found = [actors.simulate(actor, cast.arms) for actor in who]
    except errors.UsageError as error:  # an arm without a mount for this task
        notify(server, "Not possible", str(error), is_bad=True)
        found = [actors.simulate(actor) for actor in who]
    return Rollouts(server, found, status)


def trocar_names(task: str) -> list[str]:
    """`<number> (seen)` of each configuration."""
    seen = registries.tasks.get(task).is_seen
    return [f"{i} ({'seen' if is_seen else 'unseen'})" for i, is_seen in enumerate(seen)]
