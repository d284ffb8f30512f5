"""Extras of `pip install "starjax[...]"`, and which of them is missing. Standard library only."""

import importlib.util

from starjax import errors

# Extra -> imported packages. Without extras, `starjax.rcm` works with jax and numpy.
PACKAGES: dict[str, tuple[str, ...]] = {
    "sim": ("filelock", "flax", "msgspec", "mujoco", "rich", "tyro"),
    "train": ("optax", "orbax", "safetensors", "scipy"),
    "report": ("PIL", "jinja2", "matplotlib", "scipy"),
    "video": ("imageio_ffmpeg",),
    "formats": ("PIL", "av", "h5py", "pyarrow", "zarr"),
    "ros": ("rosbags",),
    "gym": ("gymnasium",),
    "serve": ("PIL", "filelock", "flax", "msgpack", "msgspec", "safetensors", "websockets"),
    "viewer": ("viser",),
    "hub": ("huggingface_hub",),
    "tensorboard": ("tensorboardX",),
    "wandb": ("wandb",),
}


def require(user: str, *extras: str) -> None:
    """Raises UsageError if a package of these extras is not installed.

    Args:
      user: command or function that needs them, e.g. `train`.
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
