"""Commands and parts of the add-on. Imports neither jax nor the add-on."""

from starjax.core.extensions import AddOn, Subcommand

_HERE = "starjax.addons.viewer"
TABLE = AddOn(
    "the browser: view, teleoperation, rollouts in 3D",
    commands={
        "view": Subcommand(
            f"{_HERE}.commands.view",
            "show a policy, an expert or a dataset in the browser",
            ("sim", "train", "viewer"),
        ),
        "teleop": Subcommand(
            f"{_HERE}.commands.teleop",
            "record demonstrations by hand in the browser",
            ("sim", "train", "viewer"),
        ),
    },
    hooks={
        "playback": f"{_HERE}.playback_3d:record",
        "dataset_page": f"{_HERE}.dataset_page:write",
    },
)
