"""Extras of `pip install "starjax[...]"`, and which of them is missing. Standard library only."""

import importlib.metadata
import importlib.util
import json
import pathlib

from starjax.core import errors

# Extra -> imported packages. Without extras, `starjax.rcm` works with jax and numpy.
PACKAGES: dict[str, tuple[str, ...]] = {
    "sim": ("filelock", "flatbuffers", "flax", "msgspec", "mujoco", "rich", "tyro"),
    "train": ("optax", "orbax", "safetensors", "scipy"),
    "report": ("PIL", "jinja2", "matplotlib", "scipy"),
    "video": ("imageio_ffmpeg",),
    "formats": ("PIL", "av", "h5py", "pyarrow", "zarr"),
    "ros": ("rosbags",),
    "ros2": ("cyclonedds",),
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
    absent = missing(*extras)
    if absent:
        wanted = ",".join(dict.fromkeys(absent.values()))
        raise errors.UsageError(
            user,
            f"{', '.join(absent)} to be installed",
            "no such package",
            install(wanted),
        )


def missing(*extras: str) -> dict[str, str]:
    """Returns the packages of these extras that are not installed, each with its extra."""
    return {
        name: extra
        for extra in extras
        for name in PACKAGES[extra]
        if importlib.util.find_spec(name) is None
    }


def install(wanted: str) -> str:
    """Returns the command that adds extras to this installation, from where it came.

    `starjax` alone would name a package of an index, which may have another owner.
    """
    checkout = pathlib.Path(__file__).parents[3]
    if (checkout / "pyproject.toml").is_file():
        here = "." if pathlib.Path.cwd() == checkout else checkout
        return f"pip install -e '{here}[{wanted}]'"
    return f"pip install '{_origin(wanted)}'"


def _origin(wanted: str) -> str:
    """Returns the requirement of this installation with extras, by its record (PEP 610)."""
    name = f"starjax[{wanted}]"
    try:
        text = importlib.metadata.distribution("starjax").read_text("direct_url.json")
        record = json.loads(text or "")
        vcs = record.get("vcs_info")
        url = f"{vcs['vcs']}+{record['url']}@{vcs['commit_id']}" if vcs else record["url"]
    except (importlib.metadata.PackageNotFoundError, ValueError, KeyError):
        return name  # from an index
    return f"{name} @ {url}"
