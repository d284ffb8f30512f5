"""Schema of dataset.json, and how schema 1 becomes it.

Schema 1 is of one arm: episodes have fields without the axis A, one camera's `image`, numbers for
radius, polar and azimuth; trocars are `[C][3]`, `scene` is the hash that is now `model`.
"""

import hashlib
import types
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from starjax import errors, schema_1
from starjax.rcm.trocar import Trocar
from starjax.rollouts import episodes, programs
from starjax.runtime import jax_settings, xla
from starjax.sim import names

SCHEMA = 2
IMPORTED = "imported.json"  # beside dataset.json: what was odd about the files of others
# Demonstrations never start from the states that an evaluation with the same seed draws.
STREAM = 0x64656D6F

_PER_ARM = ("p", "R", "gripper", "command_p", "command_R", "command_gripper", "rcm_error")
_PLACE = ("radius", "polar", "azimuth")


class DemoSettings(NamedTuple):
    """Which demonstrations a dataset has.

    Attributes:
      per_trocar: successful episodes wanted at each configuration of trocars.
      seed: of all of them.
      max_steps: control steps after which an episode has failed.
      keep_failures: whether failed episodes are stored too.
      expert: which of the task's; empty for its first one.
      randomise: what is wrong with their environment: highest levels by name.
    """

    per_trocar: int
    seed: int
    max_steps: int
    keep_failures: bool = False
    expert: str = ""
    randomise: Mapping[str, float] = types.MappingProxyType({})


def describe(env: Any, trocars: Trocar, settings: DemoSettings) -> dict[str, Any]:
    """Describes a dataset: the content of dataset.json, and by `store.digest` its name.

    Args:
      env: `sim.env.Env`.
      trocars: fields `[C, A]`.
    """
    frame = programs.frame(env, episodes.DEMONSTRATION)
    features = {
        name: {
            "shape": list(leaf.shape),
            "dtype": np.dtype(leaf.dtype).str,
            "what": episodes.what(name),
        }
        for name, leaf in frame.items()
    }
    rule = f"fold_in(fold_in(fold_in(key(seed), {STREAM}), trocar), trial)"
    return {
        "schema": SCHEMA,
        **{name: x for name, x in settings._asdict().items() if name != "randomise"},
        # Where nothing is wrong, datasets are called as they were before anything could be.
        **({"randomise": dict(settings.randomise)} if settings.randomise else {}),
        "expert": expert_name(env.task, settings),
        "scene": env.names._asdict(),
        "trocars": np.stack([np.asarray(f, np.float64) for f in trocars], -1).tolist(),
        "p_world_ref": np.asarray(env.p_world_ref, np.float64).tolist(),
        "roll_zero": [float(slot.roll_zero) for slot in env.task.slots],
        "control_hz": env.control_hz,
        "task": {
            "fields": [list(field) for field in env.task.fields],
            "labels": list(env.task.labels),
            "stages": list(env.task.stages),
        },
        "features": features,
        "model": model_hash(env.scene),
        "seed_rule": rule,
        "versions": xla.versions(),
        **jax_settings.record(),
    }


def expert_name(task: Any, settings: DemoSettings) -> str:
    """Which of the task's experts the settings mean."""
    name = settings.expert or next(iter(task.experts))
    errors.choice("expert", name, task.experts)
    return name


def upgraded(description: Mapping[str, Any]) -> dict[str, Any]:
    """A description of any schema as schema 2 says it; `schema` stays that of the files."""
    if description["schema"] == SCHEMA:
        return dict(description)
    found = schema_1.with_expert(description, usual="default")
    camera = episodes.IMAGE + names.FIRST.cameras[0]
    return found | {
        "scene": names.FIRST._asdict(),
        "model": description["scene"],
        "trocars": [[trocar] for trocar in description["trocars"]],
        "p_world_ref": [description["p_world_ref"]],
        "roll_zero": [0.0],
        "features": {
            camera if name == "image" else name: feature
            | {"shape": [1, *feature["shape"]] if name in _PER_ARM else feature["shape"]}
            for name, feature in description["features"].items()
        },
    }


def file_name(schema: int, field: str) -> str:
    """The file that a field of schema 2 lies in."""
    return f"{'image' if schema == 1 and field.startswith(episodes.IMAGE) else field}.npy"


def with_arms(schema: int, field: str, array: np.ndarray) -> np.ndarray:
    """A field's `[F, ...]` with its axis of arms, `[F, A, ...]`, if it is one that has it."""
    return array[:, None] if schema == 1 and field in _PER_ARM else array


def trocars_of(records: Sequence[Mapping[str, Any]]) -> Trocar:
    """Trocars `[D, A]` of episodes' records of any schema."""
    rows = ([np.atleast_1d(record[name]) for record in records] for name in _PLACE)
    return Trocar(*(np.array(row, np.float32) for row in rows))


def model_hash(scene: Any) -> str:
    """Identifies the compiled scene; empty where the environment has no MuJoCo model."""
    mj_model = getattr(scene, "mj_model", None)
    if mj_model is None:
        return ""
    import mujoco

    buffer = np.zeros(mujoco.mj_sizeModel(mj_model), np.uint8)
    mujoco.mj_saveModel(mj_model, None, buffer)
    return hashlib.sha256(buffer.tobytes()).hexdigest()
