"""A trained policy as one file, `policy.safetensors`: averaged weights, normaliser, settings.

No pickle, readable without starjax: arrays are named by their path, the one metadata entry is JSON.
"""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import safetensors
import safetensors.numpy

from starjax import config
from starjax.data import normalizer
from starjax.runtime import files

_ENTRY = "starjax"  # a single one: several have no fixed order in the file
_NETWORK, _SCALING = "params", "normalizer"


class Trained(NamedTuple):
    """What evaluation needs of a training.

    Attributes:
      weights_of: the row of Table II that was trained.
      policy: its networks.
      train: its settings, of which inference uses the crop.
      params: averaged weights.
      normalizer: fitted to the training frames.
    """

    weights_of: str
    policy: config.PolicyConfig
    train: config.TrainConfig
    params: dict[str, Any]
    normalizer: normalizer.Normalizer


def save(path: Path, trained: Trained) -> None:
    """Writes the file atomically; the same policy gives the same bytes."""
    arrays = {f"{_NETWORK}.{name}": leaf for name, leaf in _flat(trained.params).items()}
    for part in dataclasses.fields(trained.normalizer):
        scaling = getattr(trained.normalizer, part.name)
        if scaling is not None:
            arrays[f"{_SCALING}.{part.name}.low"] = np.asarray(scaling.low)
            arrays[f"{_SCALING}.{part.name}.high"] = np.asarray(scaling.high)
    about = {
        "weights_of": trained.weights_of,
        "policy": dataclasses.asdict(trained.policy),
        "train": dataclasses.asdict(trained.train),
    }
    metadata = {_ENTRY: json.dumps(about, sort_keys=True)}
    files.write_bytes(path, safetensors.numpy.save(arrays, metadata))


def load(path: Path) -> Trained:
    """Reads what `save` wrote.

    Raises:
      ValueError: not such a file, or a damaged one.
    """
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            about = json.loads(file.metadata()[_ENTRY])
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (safetensors.SafetensorError, OSError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: expected a policy written by starjax: {error}") from error
    network = {name: leaf for name, leaf in arrays.items() if name.startswith(f"{_NETWORK}.")}
    scalings = {
        part.name: normalizer.MinMax(arrays[f"{_SCALING}.{part.name}.low"], arrays[key])
        if (key := f"{_SCALING}.{part.name}.high") in arrays
        else None
        for part in dataclasses.fields(normalizer.Normalizer)
    }
    return Trained(
        weights_of=about["weights_of"],
        policy=config.from_dict(config.PolicyConfig, about["policy"]),
        train=config.from_dict(config.TrainConfig, about["train"]),
        params=_nested(network)[_NETWORK],
        normalizer=normalizer.Normalizer(**scalings),
    )


def _flat(tree: Mapping[str, Any], prefix: str = "") -> dict[str, np.ndarray]:
    """Leaves of nested dictionaries by their dotted path; no name contains a dot."""
    found = {}
    for name, value in tree.items():
        if isinstance(value, Mapping):
            found |= _flat(value, f"{prefix}{name}.")
        else:
            found[prefix + name] = np.ascontiguousarray(jax.device_get(value))
    return found


def _nested(flat: Mapping[str, Any]) -> dict[str, Any]:
    tree: dict[str, Any] = {}
    for name, value in flat.items():
        *parents, leaf = name.split(".")
        place = tree
        for parent in parents:
            place = place.setdefault(parent, {})
        place[leaf] = value
    return tree
