"""Fills the ResNet-18 trunk with ImageNet weights from a `.safetensors` file of the user's.

Names are torchvision's and timm's (`layer1.0.conv1.weight`), under any prefix: `module.`,
`state_dict.`, `model.`, `encoder.`, `backbone.`, MoCo's `module.encoder_q.`, R3M's
`module.convnet.`. BatchNorm's parameters are ignored and GroupNorm starts at its default, as in
Diffusion Policy; the classifier is dropped.
"""

import pathlib
import re
from collections.abc import Collection
from typing import Any

import flax.traverse_util
import jax.numpy as jnp
import numpy as np
import safetensors
import safetensors.numpy

from starjax.core import errors

_PICKLES = (b"PK\x03\x04", b"\x80")  # how torch's files begin: zipped since 1.6, and before
# Copies next to the encoder in a file of MoCo (its momentum encoder) or DINO (its student).
_COPIES = ("encoder_k.", "momentum_encoder.", "student.")
_SHOWN = 4  # names in a message


def load_resnet18(trunk: dict[str, Any], path: str | pathlib.Path) -> dict[str, Any]:
    """Returns `trunk` with every convolution replaced by the file's.

    Args:
      trunk: parameters of `resnet.ResNet18`: `params["params"]["trunk"]` of an `ImageEncoder`.
      path: of the `.safetensors` file.

    Raises:
      errors.UsageError: the file is of another kind or damaged, its weights are not a ResNet-18's,
        or one of them has another shape or is not finite.
    """
    flat = flax.traverse_util.flatten_dict(trunk)
    convolutions = {_name(names): names for names in flat if names[-1] == "kernel"}
    weights = read_weights(path)
    prefix = _prefix(weights, convolutions, path)
    filled = {
        convolutions[name]: _kernel(weights[prefix + name], flat[names], prefix + name, path)
        for name, names in convolutions.items()
    }
    return flax.traverse_util.unflatten_dict({**flat, **filled})


def read_weights(path: str | pathlib.Path) -> dict[str, np.ndarray]:
    """Reads all tensors of a `.safetensors` file, by name."""
    path, expected = pathlib.Path(path), "a .safetensors file"
    try:
        return safetensors.numpy.load_file(path)
    except (safetensors.SafetensorError, OSError) as error:
        got, hint = f"{path.name}: {error}", ""
        if _is_pickle(path):
            got = f"{path.name}, a pickle of torch's"
            hint = (
                "convert it where torch is installed: safetensors.torch.save_file of the result of "
                "torch.load (docs/start/train-gpu.md)"
            )
        raise errors.UsageError(str(path), expected, got, hint) from error
    except (AttributeError, KeyError, TypeError) as error:  # a type that numpy lacks
        got = f"{path.name} with a tensor of type {error}"
        raise errors.UsageError(str(path), f"{expected} of float types", got) from error


def _is_pickle(path: pathlib.Path) -> bool:
    """Returns True if a file of any name begins as torch's pickles do."""
    try:
        with path.open("rb") as file:
            return file.read(4).startswith(_PICKLES)
    except OSError:
        return False


def _name(names: tuple[str, ...]) -> str:
    """Returns torchvision's name: layer2.0.conv1.weight for (layer2_0, conv1, kernel)."""
    return ".".join(names[:-1]).replace("_", ".") + ".weight"


def _prefix(names: Collection[str], wanted: Collection[str], path: str | pathlib.Path) -> str:
    """Returns the prefix of the names of the one ResNet-18 that is found."""
    first = "conv1.weight"
    prefixes = [
        name.removesuffix(first) for name in names if re.search(r"(^|\.)conv1\.weight$", name)
    ]
    complete = [prefix for prefix in prefixes if all(prefix + name in names for name in wanted)]
    encoders = [prefix for prefix in complete if not any(copy in prefix for copy in _COPIES)]
    if len(encoders) > 1:
        got, hint = f"several: {_listed(encoders)}", "write one of them into a file of its own"
        raise errors.UsageError(str(path), "one ResNet-18", got, hint)
    if not encoders:
        expected = f"a ResNet-18's names ({_listed(wanted)})"
        raise errors.UsageError(str(path), expected, _listed(names) or "none")
    (prefix,) = encoders
    blocks = re.compile(re.escape(prefix) + r"(layer\d\.\d+\.conv\d\.weight)$")
    more = [name for name in names if (block := blocks.match(name)) and block[1] not in wanted]
    if more:
        raise errors.UsageError(str(path), "a ResNet-18", f"a larger one, with {_listed(more)}")
    return prefix


def _listed(names: Collection[str]) -> str:
    shown = ", ".join(list(names)[:_SHOWN])
    return f"{shown} and {len(names) - _SHOWN} more" if len(names) > _SHOWN else shown


def _kernel(weight: np.ndarray, like: Any, name: str, path: str | pathlib.Path) -> Any:
    """Returns a kernel, from torch's OIHW to HWIO, checked against the one that it replaces."""
    expected = (like.shape[3], like.shape[2], like.shape[0], like.shape[1])
    if weight.shape != expected:
        raise errors.UsageError(str(path), f"shape {expected} of {name}", weight.shape)
    weight = np.asarray(weight, np.float32)  # also from float16 and bfloat16
    if not np.isfinite(weight).all():
        raise errors.UsageError(str(path), f"finite values in {name}", "others")
    return jnp.asarray(weight.transpose(2, 3, 1, 0), like.dtype)
