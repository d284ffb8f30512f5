"""Use of a GPU: devices of the system before jax has started, jax's own answer after.

Only functions for use after the start import jax.
"""

import importlib.util
import os
from pathlib import Path

# NVIDIA's driver, a container with one card, Linux inside Windows (WSL2).
_DEVICES = ("nvidiactl", "nvidia[0-9]*", "dxg")
_PLUGINS = ("jax_cuda12_plugin", "jax_cuda13_plugin")
_DEV = Path("/dev")


def is_shown() -> bool:
    """Returns whether the system shows a device that may be an NVIDIA GPU."""
    return any(any(_DEV.glob(pattern)) for pattern in _DEVICES)


def has_plugin() -> bool:
    """Returns whether one of jax's CUDA plugins is installed."""
    return any(importlib.util.find_spec(name) for name in _PLUGINS)


def forbidden() -> str:
    """Returns the variable, with its value, that keeps jax from a GPU; else empty."""
    for name in ("JAX_PLATFORMS", "JAX_PLATFORM_NAME"):
        first = os.environ.get(name, "").split(",")[0]
        if first not in ("", "cuda", "gpu"):
            return f"{name}={os.environ[name]}"
    name = "CUDA_VISIBLE_DEVICES"
    if os.environ.get(name, "0").strip() in ("", "-1"):
        return f"{name}={os.environ[name]}"
    return ""


def is_likely() -> bool:
    """Returns whether jax will run on a GPU, as far as that shows before it has started (2 s)."""
    return is_shown() and has_plugin() and not forbidden()


def is_used() -> bool:
    """Returns whether jax runs on a GPU; starts jax."""
    import jax

    return jax.default_backend() == "gpu"


def why_unused() -> str:
    """Returns the reason why jax does not use the GPU of the system; empty if there is no GPU."""
    if not is_shown():
        return ""
    if by_variable := forbidden():
        return by_variable
    if not has_plugin():
        return "no CUDA plugin of jax is installed"
    import jax

    try:
        jax.devices("cuda")
    except RuntimeError as error:
        return str(error).splitlines()[0]
    return "jax prefers another device"
