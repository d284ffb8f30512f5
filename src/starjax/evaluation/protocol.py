"""The trocar benchmark: one protocol for all policies, which makes their results comparable.

A trial follows from (seed, trocar, number), so the first `TRIALS` of a longer evaluation are the
protocol's. The judge is `Task.status`: strict success, within the task's time limit. A change of
the physics or of a judge changes the meaning of a success: it raises `VERSION`, and
tests/evaluation/test_protocol.py has the digests that tell.
"""

import dataclasses
from collections.abc import Iterator
from typing import Any, TypeVar

VERSION = 1
SEED = 0  # seed of all trials
TROCARS, SEEN = 12, 8  # configurations of a task; the first ones are of the demonstrations
TRIALS = 50  # at each of a task's configurations
SWEEP_TROCARS = 200  # other configurations, of Eq. 19 or a task's regions; a trial at each
STRESS_TRIALS = 9  # at each of a task's configurations, for each disturbance
TIME_LIMIT_S = {  # simulated seconds of a trial, by task
    "reach": 15.0,
    "needle_pick": 30.0,
    "endoscope_track": 30.0,
    "peg_transfer": 60.0,
    "ring_on_wire": 60.0,
    "peg_transfer_bimanual": 60.0,
    "needle_handover": 60.0,
}
STRESS = {  # level of each disturbance alone, in its unit
    "trocar_offset": 10.0,
    "breathing": 5.0,
    "breathing_tracked": 5.0,
    "camera": 10.0,
    "darkness": 0.4,
    "tint": 0.4,
    "noise": 0.1,
    "blur": 2.0,
    "smoke": 0.5,
    "blood": 0.2,
    "observation_delay": 4.0,
    "action_delay": 4.0,
    "observation_dropout": 0.5,
    "weak_servos": 0.5,
    "friction": 0.5,
    "mass": 0.5,
}


_PARTS = {
    "evaluate": (TROCARS, TRIALS),
    "sweep": (SWEEP_TROCARS, 1),
    "stress": (TROCARS, STRESS_TRIALS),
}
COMMANDS = tuple(_PARTS)

SettingsT = TypeVar("SettingsT")


def settings(command: str, task: str, of: SettingsT) -> SettingsT:
    """Returns a command's trials, `of` with the protocol's number and time limit.

    Raises:
      KeyError: the benchmark lacks the task.
    """
    values: dict[str, Any] = {"trials": _PARTS[command][1], "time_limit_s": TIME_LIMIT_S[task]}
    return dataclasses.replace(of, **values)  # type: ignore


def departures(
    command: str, task: str, seed: int | None, time_limit_s: float, trocars: int, per_trocar: int
) -> Iterator[str]:
    """Yields the differences of a result's trials from the protocol, as phrases.

    More trials at each trocar are allowed: the first ones count.
    """
    if task not in TIME_LIMIT_S:
        yield f"the benchmark lacks the task {task}"
        return
    wanted_trocars, least = _PARTS[command]
    if trocars != wanted_trocars:
        yield f"{trocars} trocars, not {wanted_trocars}"
    if per_trocar < least:
        yield f"{per_trocar} trials per trocar, not {least}"
    if seed != SEED:
        yield f"seed {seed} of the trials, not {SEED}"
    if time_limit_s != TIME_LIMIT_S[task]:
        yield f"time limit {time_limit_s:g} s, not {TIME_LIMIT_S[task]:g} s"
