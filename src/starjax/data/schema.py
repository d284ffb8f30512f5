"""Schema of dataset.json."""

import hashlib
import math
import types
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from starjax.core import errors, sources
from starjax.data import store
from starjax.rcm.trocar import Trocar
from starjax.runtime import jax_settings, xla
from starjax.sim import registries
from starjax.sim.rollouts import episodes, programs
from starjax.sim.scene import Scene
from starjax.sim.state import Env
from starjax.sim.task import Task

IMPORTED_FILES = "imported_files.json"  # bytes and time of each file of others
IMPORTED = "imported.json"  # beside dataset.json: what was odd about the files of others
# Demonstrations never start from the states that an evaluation with the same seed draws.
STREAM = 0x64656D6F


def seed_rule(stream: int) -> str:
    """Returns the rule that gives the key of a trial, for dataset.json."""
    return f"fold_in(fold_in(fold_in(key(seed), {stream}), trocar), trial)"


SEED_RULE = seed_rule(STREAM)
_NESTED = ("randomise", "disturbances")  # settings that are described in another form


class DemoSettings(NamedTuple):
    """Settings of a dataset of demonstrations.

    Attributes:
      per_trocar: successful episodes wanted at each configuration of trocars.
      seed: of all of them.
      max_steps: control steps after which an episode has failed.
      keep_failures: store failed episodes too.
      expert: key of `Task.experts`; empty for the first one.
      randomise: maximum levels of disturbances by name.
      disturbances: identities of these.
    """

    per_trocar: int
    seed: int
    max_steps: int
    keep_failures: bool = False
    expert: str = ""
    randomise: Mapping[str, float] = types.MappingProxyType({})
    disturbances: tuple[sources.Identity, ...] = ()


def describe(env: Env, trocars: Trocar, settings: DemoSettings) -> dict[str, Any]:
    """Describes a dataset: the content of dataset.json, and by `store.digest` its name.

    Args:
      env: `sim.env.Env`.
      trocars: fields `[C, A]`.
    """
    expert = expert_name(env.task, settings)
    parts = [
        *registries.parts(env.names),
        sources.Identity(
            f"expert {env.task.name}.{expert}", env.task.expert_version, env.task.experts[expert]
        ),
        *settings.disturbances,
    ]
    return {
        "schema": store.SCHEMA,
        **{name: x for name, x in settings._asdict().items() if name not in _NESTED},
        # Omitted if empty, so digests of datasets without disturbances hold.
        **({"randomise": dict(settings.randomise)} if settings.randomise else {}),
        "expert": expert,
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
        "features": features(env),
        "model": model_hash(env.scene),
        "seed_rule": SEED_RULE,
        **sources.record(parts),
        "versions": {**xla.versions(), **sources.packages(parts)},
        **jax_settings.record(),
    }


def stream(description: Mapping[str, Any]) -> int:
    """Returns the stream of a dataset's trials."""
    return description.get("stream", STREAM)


def features(env: Env) -> dict[str, dict[str, Any]]:
    """Describes the arrays of a recorded control step, by name."""
    return {
        name: {
            "shape": list(leaf.shape),
            "dtype": np.dtype(leaf.dtype).str,
            "what": episodes.what(name),
        }
        for name, leaf in programs.frame(env, episodes.DEMONSTRATION).items()
    }


def frame_bytes(features: Mapping[str, Mapping[str, Any]]) -> int:
    """Returns the bytes of one recorded control step with the given features."""
    return sum(math.prod(x["shape"]) * np.dtype(x["dtype"]).itemsize for x in features.values())


def expert_name(task: Task, settings: DemoSettings) -> str:
    """Returns the name of the expert, by default the task's first one."""
    name = settings.expert or next(iter(task.experts))
    errors.choice("expert", name, task.experts)
    return name


def trocars_of(records: Sequence[Mapping[str, Any]]) -> Trocar:
    """Returns the trocars `[D, A]` of episodes' records."""
    rows = ([record[name] for record in records] for name in Trocar._fields)
    return Trocar(*(np.array(row, np.float32) for row in rows))


def model_hash(scene: Scene) -> str:
    """Identifies the compiled scene; empty where the environment has no MuJoCo model."""
    mj_model = getattr(scene, "mj_model", None)
    if mj_model is None:
        return ""
    import mujoco

    buffer = np.zeros(mujoco.mj_sizeModel(mj_model), np.uint8)
    mujoco.mj_saveModel(mj_model, None, buffer)
    return hashlib.sha256(buffer.tobytes()).hexdigest()
