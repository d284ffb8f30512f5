"""`starjax find-mount ARM TOOL WORKSPACE`: a search for the pose of an arm's base."""

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import tyro

from starjax.cli import options
from starjax.core import config as config_lib
from starjax.core import errors
from starjax.runtime import jax_start, xla

if TYPE_CHECKING:
    from starjax.sim.arms.base import Mount
    from starjax.sim.mounts import Fit
    from starjax.sim.workspaces import Workspace

DESCRIPTION = """Searches the base pose of an arm, the rotation of its tool, and its home.

WORKSPACE is a region of trocars and targets, or a task for the workspaces of its arms. The arm must
reach every target through every trocar with every roll. The command prints the mount that is
farthest from joint limits and singular configurations, as a row of the arm's record.

Examples:
  starjax find-mount fr5 grasper peg_transfer
  starjax find-mount ur5e grasper board --tilts"""


@dataclasses.dataclass(frozen=True)
class FindMountArgs:
    """Flags of the command."""

    arm: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="ARM")]  # name of an arm
    tool: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="TOOL")]  # name of a tool
    # name of a workspace or of a task
    workspace: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="WORKSPACE")]
    seed: config_lib.Seed = 0  # random seed of the search
    tilts: bool = False  # also try tilted and hanging bases


def main(argv: Sequence[str]) -> int:
    """Prints the figures of each round and the best mount."""
    args = options.parse("find-mount", FindMountArgs, argv, DESCRIPTION)
    xla.prepare_xla()
    jax_start.require_devices("starjax.addons.robots.mount_search")

    from starjax.addons.robots import mount_search
    from starjax.sim import mounts, registries

    at = mounts.bench(registries.arms.get(args.arm), registries.tools.get(args.tool))
    are_good = []
    for name, workspace in _workspaces(args.workspace).items():
        print(f"{args.arm} with {args.tool} in {name}", flush=True)
        mount, least = mount_search.search(at, workspace, args.seed, args.tilts, _tell)
        print(f"\n{_record(args.tool, name, mount, least)}\n")
        are_good.append(mounts.is_good(least))
    if all(are_good):
        return 0
    print(
        f"Not every mount may be used. It needs at least {mounts.MIN_MARGIN:g} rad to the limits, "
        f"a singular value of {mounts.MIN_SINGULAR:g} m, every pose reached and no link in the "
        "table. Another --seed, or --tilts, may find one. Next to the table an elbow may be lower: "
        "`watched` in the arm's record is the first joint that may not."
    )
    return 1


def _tell(fit: "Fit") -> None:
    print(f"  {_figures(fit)}", flush=True)


def _workspaces(name: str) -> "dict[str, Workspace]":
    """Returns a workspace by name, or those of a task's arms with their nominal trocars."""
    from starjax.sim import registries

    if name in registries.workspaces.names():
        return {name: registries.workspaces.get(name)}
    known = [*registries.workspaces.names(), *registries.tasks.names()]
    errors.choice("WORKSPACE", name, known)
    return {
        slot.workspace: registries.workspaces.get(slot.workspace)._replace(
            p_world_ref=slot.p_world_ref, roll_zero=slot.roll_zero
        )
        for slot in registries.tasks.get(name).slots
    }


def _figures(fit: "Fit") -> str:
    reached = f"missed by {1e3 * fit.residual:.2g} mm" if fit.residual > 1e-4 else "all reached"
    return (
        f"{reached}, {fit.margin:.3f} rad to the limits, singular value {fit.singular:.3f} m, "
        f"links {fit.height:.2f} m above the table"
    )


def _record(tool: str, workspace: str, mount: "Mount", fit: "Fit") -> str:
    """Returns the row of `Arm.mounts` with its figures in a comment."""
    defaults = mount._field_defaults
    changed = {
        name: value for name, value in mount._asdict().items() if value != defaults.get(name)
    }
    inside = "".join(f"\n    {name}={value!r}," for name, value in changed.items())
    return f"# {_figures(fit)}\n({tool!r}, {workspace!r}): Mount({inside}\n),".replace("'", '"')
