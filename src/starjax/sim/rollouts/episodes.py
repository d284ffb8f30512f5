"""Finished episodes: their trial, outcome and recorded fields.

The receiver of the episodes chooses the fields that are recorded at each control step.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm
from starjax.core.types import Command, Observation, Pose
from starjax.rcm.trocar import Trocar

Trial = tuple[int, int]  # index of the trocars' configuration, number there

IMAGE = "image_"  # before a camera's name
ENDOSCOPE = ("endoscope_R", "endoscope_p")  # parts of the endoscope's pose

# How an episode ended: fields of EnvState.
FLAGS = ("collided", "invalid", "loose", "lost", "success")

# Fields of a demonstration; images and state only if they are observed.
FIELDS = {
    "p": "m, measured tip positions, world frame",
    "R": "measured tip rotations R_world_tip",
    "gripper": "measured openings, -1 closed to +1 open",
    IMAGE: "uint8 RGB",
    "state": "fields of the task, one after another",
    "endoscope_R": "R_world_camera of the endoscope: x to the right, y up, it looks along -z",
    "endoscope_p": "m, position of the endoscope's lens, world frame",
    "command_p": "m, commanded tip positions, world frame",
    "command_R": "commanded R_world_tip",
    "command_gripper": "-1 squeeze to +1 open",
    "qpos": "generalised coordinates of the model, before the command",
    "rcm_error": "m, executed by the command",
    "wrist": "rad, measured pitch and yaw of the wrists, 0 for a straight tool",
    "shaft_p": "m, measured positions of the shafts on their pitch axes, world frame",
    "shaft_R": "measured rotations R_world_shaft",
    "command_wrist": "rad, commanded pitch and yaw of the wrists",
    "actor": "agent of the command: 0 policy, 1 expert, 2 person",
}


class Episode(NamedTuple):
    """One that is over.

    Attributes:
      outcome: JSON values: which trial it is, and how it ended.
      arrays: of each field, parts that make `[length, ...]` along the first axis.
      lane: position in its batch.
    """

    outcome: dict[str, Any]
    arrays: dict[str, list[np.ndarray]]
    lane: int = 0

    @property
    def trial(self) -> Trial:
        """Index of the configuration, and number there."""
        return self.outcome["trocar"], self.outcome["trial"]

    def joined(self, name: str) -> np.ndarray:
        """Returns a field `[length, ...]`."""
        return np.concatenate(self.arrays[name])


class Step(NamedTuple):
    """One control step of N episodes.

    Attributes:
      observed: Observation before it, None if no recorded field needs it.
      label: Command `[N, A]` to record. executed: Command `[N, A]`.
      before, after: EnvState.
      memory: the agent's after it acted, None while shapes are traced without an agent.
    """

    observed: Observation | None
    label: Command
    executed: Command
    before: Any
    after: Any
    memory: Any = None


class Record(NamedTuple):
    """Fields that are recorded of every control step.

    Attributes:
      fields: (Step) -> name -> `[N, ...]`.
      observes: True if it needs `Step.observed`.
      frames: control steps between two looks of the host; it bounds the memory that images take on
        the device.
    """

    fields: Callable[[Step], dict[str, jax.Array]]
    observes: bool
    frames: int


def _demonstrated(step: Step) -> dict[str, jax.Array]:
    seen, label = step.observed, step.label
    assert seen is not None
    found = {
        "p": seen.pose.p,
        "R": seen.pose.R,
        "gripper": seen.gripper,
        **{f"{IMAGE}{camera}": image for camera, image in (seen.images or {}).items()},
        "state": seen.state,
        **_of_endoscope(seen.endoscope),
        **_of_wrist(step),
        "command_p": label.pose.p,
        "command_R": label.pose.R,
        "command_gripper": label.gripper,
        "qpos": step.before.coordinates,
        "rcm_error": step.after.rcm_error,
    }
    return {name: leaf for name, leaf in found.items() if leaf is not None}


def without_images(step: Step) -> dict[str, jax.Array]:
    """Returns the fields of a demonstration except the images, which follow from them.

    Images are drawn at every step of a record that observes them.
    """
    state, seen = step.before, step.observed
    if seen is None:
        seen = Observation(state.pose, state.gripper, endoscope=state.endoscope)
    return _demonstrated(step._replace(observed=seen._replace(images=None)))


def _scored(step: Step) -> dict[str, jax.Array]:
    after = step.after
    shaft = step.executed.pose if after.commanded_shaft is None else after.commanded_shaft
    commanded = rcm.rcm_error(shaft, after.trocar.p_world_trocar)
    return {
        "rcm_error": after.rcm_error,
        "rcm_error_within": after.rcm_error_within,
        "rcm_error_commanded": commanded,
        "reached_p": after.pose.p,
        "reached_qpos": after.coordinates,
        **_of_endoscope(after.endoscope),
    }


def _of_wrist(step: Step) -> dict[str, jax.Array]:
    """Returns the fields of a scene with a wrist; a command without angles has a straight one."""
    shaft, angles = step.before.shaft, step.before.wrist
    if shaft is None:
        return {}
    wanted = step.label.wrist
    return {
        "wrist": angles,
        "shaft_p": shaft.p,
        "shaft_R": shaft.R,
        "command_wrist": jnp.zeros_like(angles) if wanted is None else wanted,
    }


def _of_endoscope(pose: Pose | None) -> dict[str, jax.Array]:
    return {} if pose is None else dict(zip(ENDOSCOPE, pose, strict=True))


DEMONSTRATION = Record(_demonstrated, observes=True, frames=16)
# Errors of each step, and where the arms were after it.
SCORE = Record(_scored, observes=False, frames=200)


def what(field: str) -> str:
    """Describes a field of `DEMONSTRATION`."""
    return FIELDS[IMAGE if field.startswith(IMAGE) else field]


def assemble(
    lane: int,
    trial: Trial,
    trocars: Trocar,
    seed: int,
    status: Mapping[str, Any],
    others: list[dict[str, np.ndarray]],
    images: Mapping[str, list[np.ndarray]],
) -> Episode:
    """Assembles the episode of a finished lane from the arrays fetched after every segment.

    Args:
      trocars: fields `[C, A]`.
      status: `[N]` each, and `labels`, after the last segment.
      others: all but the images, `[N, T, ...]` each.
      images: of this lane alone, `[T, ...]`.
    """
    length = int(status["length"][lane])
    outcome = {
        "trocar": trial[0],
        **{name: field[trial[0]].tolist() for name, field in trocars._asdict().items()},
        "trial": trial[1],
        "seed": seed,
        "length": length,
        **{name: bool(status[name][lane]) for name in FLAGS},
        "stage": int(status["stage"][lane]),
        "labels": {name: int(label[lane]) for name, label in status["labels"].items()},
    }
    fields = {name: [segment[name][lane] for segment in others] for name in others[0]}
    fields |= images
    # It ends in the last segment.
    for parts in fields.values():
        parts[-1] = parts[-1][: length - sum(map(len, parts[:-1]))]
    return Episode(outcome, {name: fields[name] for name in sorted(fields)}, lane)
