"""Commands and parts of the add-on. Imports neither jax nor the add-on."""

from starjax.core.extensions import AddOn, Subcommand

_HERE = "starjax.addons.six_blocks"
TABLE = AddOn(
    "the exercise of surgeons: six blocks, one after another",
    commands={
        "six-blocks": Subcommand(
            f"{_HERE}.command", "evaluate six successive bimanual transfers", ("sim", "train")
        ),
    },
)
