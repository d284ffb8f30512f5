"""Fills the ResNet-18 trunk with ImageNet weights from a file that the user has.

Either torchvision's `resnet18-*.pth` (never unpickled, see `torch_file`) or a `.safetensors` with
the same names, as timm publishes. BatchNorm's parameters are ignored and GroupNorm starts at its
default, as in Diffusion Policy; the classifier is dropped.
"""

import hashlib
import pathlib
import re
from typing import Any

import flax.traverse_util
import jax.numpy as jnp
import numpy as np
import safetensors
import safetensors.numpy

from starjax.models import torch_file


def load_resnet18(trunk: dict[str, Any], path: str | pathlib.Path) -> dict[str, Any]:
    """`trunk` with every convolution replaced by the file's.

    Args:
      trunk: parameters of `resnet.ResNet18`: `params["params"]["trunk"]` of an `ImageEncoder`.
      path: `.pth`, `.pt` or `.safetensors`.

    Raises:
      ValueError: a weight is missing, has another shape or is not finite, the file is damaged, or
        its hash is not the one in its name.
    """
    weights = read_weights(path)
    filled = {}
    for names, value in flax.traverse_util.flatten_dict(trunk).items():
        if names[-1] == "kernel":
            # ("layer2_0", "downsample_0", "kernel") is torchvision's layer2.0.downsample.0.weight.
            name = ".".join(names[:-1]).replace("_", ".") + ".weight"
            filled[names] = jnp.asarray(_convolution(weights, name, value.shape, path), value.dtype)
        else:
            filled[names] = value
    return flax.traverse_util.unflatten_dict(filled)


def read_weights(path: str | pathlib.Path) -> dict[str, np.ndarray]:
    """All tensors of a weight file, by name, once the hash of torch's agrees with its name."""
    path = pathlib.Path(path)
    if not path.is_file():
        raise ValueError(f"encoder weights: expected a file, got {path}")
    if path.suffix in (".pth", ".pt"):
        _check_hash(path)
        return torch_file.read(path)
    if path.suffix != ".safetensors":
        raise ValueError(f"encoder weights: expected .pth, .pt or .safetensors, got {path}")
    try:
        return safetensors.numpy.load_file(path)
    except (safetensors.SafetensorError, AttributeError) as error:  # as of types numpy lacks
        raise ValueError(f"{path}: not a readable safetensors file: {error}") from error


def _convolution(
    weights: dict[str, np.ndarray], name: str, shape: tuple[int, ...], path: str | pathlib.Path
) -> np.ndarray:
    """The kernel `name`, from torch's OIHW to HWIO, checked against the `shape` expected."""
    if name not in weights:
        raise ValueError(f"{path}: expected ResNet-18 weights, {name} is missing")
    kernel = weights[name]
    expected = (shape[3], shape[2], shape[0], shape[1])
    if kernel.shape != expected:
        raise ValueError(f"{path}: {name}: expected shape {expected}, got {kernel.shape}")
    if not np.isfinite(kernel).all():
        raise ValueError(f"{path}: {name}: expected finite values")
    return kernel.transpose(2, 3, 1, 0)


def _check_hash(path: pathlib.Path) -> None:
    """torchvision's names end in the start of the file's sha256: `resnet18-f37072fd.pth`."""
    found = re.search(r"-([0-9a-f]{8,64})$", path.stem)
    if found:
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        if not digest.startswith(found[1]):
            raise ValueError(f"{path}: expected sha256 {found[1]}.., got {digest[:16]}..")
