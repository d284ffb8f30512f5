"""Commands and parts of the add-on. Imports neither jax nor the add-on."""

from starjax.core.extensions import AddOn

_HERE = "starjax.addons.suture"
TABLE = AddOn(
    "needles with a wrist through tissue, with a thread",
    policies=("needle_drive", "suture_throw"),
    parts={
        "task": {
            "needle_regrasp": f"{_HERE}.needle_regrasp.task:TASK",
            "needle_drive": f"{_HERE}.needle_drive.task:TASK",
            "needle_drive_sh": f"{_HERE}.needle_drive.task:SMALL",
            "needle_drive_dial": f"{_HERE}.needle_drive.dial:TASK",
            "suture_throw": f"{_HERE}.suture_throw.task:TASK",
        },
        "rescuer": {
            "needle_regrasp": f"{_HERE}.needle_regrasp.rescue:RESCUER",
            "suture_throw": f"{_HERE}.suture_throw.rescue:RESCUER",
            "needle_drive": f"{_HERE}.needle_drive.rescue:RESCUER",
            "needle_drive_sh": f"{_HERE}.needle_drive.rescue:SMALL",
            "needle_drive_dial": f"{_HERE}.needle_drive.rescue:DIAL",
            "needle_drive_dial.one_plane": f"{_HERE}.needle_drive.rescue:DIAL_ONE_PLANE",
        },
    },
)
