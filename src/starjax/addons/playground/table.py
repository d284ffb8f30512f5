"""Commands and parts of the add-on. Imports neither jax nor the add-on."""

from starjax.core.extensions import AddOn

_HERE = "starjax.addons.playground"
TABLE = AddOn(
    "tasks as environments of MuJoCo Playground",
)
