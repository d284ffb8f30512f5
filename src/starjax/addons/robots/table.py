"""Commands and parts of the add-on. Imports neither jax nor the add-on."""

from starjax.core.extensions import AddOn, Subcommand

_HERE = "starjax.addons.robots"
TABLE = AddOn(
    "the patient side manipulator on CRTK's topics of ROS 2, mounts of arms",
    commands={
        "find-mount": Subcommand(
            f"{_HERE}.find_mount", "search the mount of an arm for a task", ("sim", "train")
        ),
        "robot": Subcommand(
            f"{_HERE}.robot", "drive a robot on ROS 2 topics by a policy", ("sim", "serve", "ros2")
        ),
        "sim-robot": Subcommand(
            f"{_HERE}.sim_robot", "serve a simulated robot on ROS 2 topics", ("sim", "ros2")
        ),
    },
)
