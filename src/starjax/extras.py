"""Extras of `pip install "starjax[...]"`, and which of them is missing. Standard library only."""

import importlib.util

from starjax import errors

# Extra -> what Python imports of it. Without any extra there are jax, numpy and `starjax.rcm`.
PACKAGES: dict[str, tuple[str, ...]] = {
    "sim": ("filelock", "flax", "msgspec", "mujoco", "rich", "tyro"),
    "train": ("optax", "orbax", "safetensors", "scipy"),
    "report": ("PIL", "jinja2", "matplotlib", "scipy"),
    "video": ("imageio_ffmpeg",),
    "formats": ("PIL", "av", "h5py", "pyarrow", "zarr"),
    "gym": ("gymnasium",),
    "serve": ("filelock", "flax", "msgpack", "msgspec", "safetensors", "websockets"),
    "viewer": ("viser",),
}


def require(user: str, *extras: str) -> None:
    """Raises UsageError if a package of these extras is not installed.

    Args:
      user: who cannot work without them, e.g. the command `train`.
      extras: keys of `PACKAGES`.
    """
    absent = {
        name: extra
        for extra in extras
        for name in PACKAGES[extra]
        if importlib.util.find_spec(name) is None
    }
    if absent:
        wanted = ",".join(dict.fromkeys(absent.values()))
        raise errors.UsageError(
            user,
            f"{', '.join(absent)} to be installed",
            "no such package",
            f"pip install 'starjax[{wanted}]'",
        )
