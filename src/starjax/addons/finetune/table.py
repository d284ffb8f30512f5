"""Commands and parts of the add-on. Imports neither jax nor the add-on."""

from starjax.core.extensions import AddOn, Subcommand

_HERE = "starjax.addons.finetune"
TABLE = AddOn(
    "fine-tuning in the simulator, experts that take over, and runtime monitors",
    commands={
        "finetune": Subcommand(
            f"{_HERE}.commands.finetune",
            "improve a trained policy in the simulator",
            ("sim", "train"),
        ),
        "calibrate": Subcommand(
            f"{_HERE}.commands.calibrate",
            "add a runtime monitor to a trained policy",
            ("sim", "train"),
        ),
    },
    parts={
        "rescuer": {
            **{
                name: f"{_HERE}.rescuers.{name}:RESCUER"
                for name in (
                    "peg_transfer",
                    "needle_pick",
                    "ring_on_wire",
                    "reach",
                    "endoscope_track",
                    "needle_handover",
                    "peg_transfer_bimanual",
                )
            },
            "peg_transfer.one_wall": f"{_HERE}.rescuers.peg_transfer:WITH_ONE_WALL",
        }
    },
)
