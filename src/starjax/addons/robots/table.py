"""Commands and parts of the add-on. Imports neither jax nor the add-on."""

from starjax.extensions import AddOn, Subcommand

_HERE = "starjax.addons.robots"
TABLE = AddOn(
    "the patient side manipulator, its messages, mounts of arms",
    commands={
        "find-mount": Subcommand(
            f"{_HERE}.find_mount", "search the mount of an arm for a task", ("sim", "train")
        ),
    },
)
