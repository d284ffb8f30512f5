"""Methods as data: the eight of Table II and further rows. Standard library only.

Other packages add theirs by an entry point of the group `starjax.methods` that names a `Method`.
"""

from collections.abc import Mapping
from typing import NamedTuple

from starjax.core import sources
from starjax.core.registry import Registry, Rows


class Method(NamedTuple):
    """A row of Table II, or a further one.

    Attributes:
      action_space: key of `starjax.rcm.ACTION_SPACES`.
      sees_trocar: the learner's model is conditioned on the trocar; the roll network always is.
      projects: poses are projected onto the RCM manifold at execution.
      hierarchical: the learner for (position, gripper), and a network for the rest, such as the
        roll; else one model.
      weights_of: the method whose weights it shares; empty for its own.
      label: name in tables; empty for its name.
      group: group in Tables II and III; further rows have another.
    """

    action_space: str
    sees_trocar: bool = False
    projects: bool = False
    hierarchical: bool = False
    weights_of: str = ""
    label: str = ""
    group: str = ""


_NAIVE, _RCM, _OURS = "Naive", "RCM action spaces", "Ours"
_BESIDE, _OTHERS, _WRIST = "Ours (ablation)", "Other packages", "With a wrist"

_BUILT_IN: dict[str, Method] = {
    "dp_ee": Method("se3", label="DP-EE", group=_NAIVE),
    "dp_ee_proj": Method(
        "se3", projects=True, weights_of="dp_ee", label="DP-EE-Proj", group=_NAIVE
    ),
    "dp_rcm1": Method("rcm1", sees_trocar=True, label="DP-RCM-1", group=_RCM),
    "dp_rcm2": Method("rcm2", sees_trocar=True, label="DP-RCM-2", group=_RCM),
    "dp_rcm3": Method("rcm3", sees_trocar=True, label="DP-RCM-3", group=_RCM),
    "dp_rcm4": Method("rcm4", sees_trocar=True, label="DP-RCM-4", group=_RCM),
    # Table II's own note: STAR-Diff-Single and DP-RCM-4 are one model, listed in both groups.
    "stardiff_single": Method(
        "rcm4", sees_trocar=True, weights_of="dp_rcm4", label="STAR-Diff-Single", group=_OURS
    ),
    "stardiff": Method("rcm4", hierarchical=True, label="STAR-Diff", group=_OURS),
    # By Proposition 1 the position model needs no trocar; this one is conditioned on it too.
    "stardiff_told": Method(
        "rcm4", sees_trocar=True, hierarchical=True, label="STAR-Diff-Told", group=_BESIDE
    ),
    "dp_ee_wrist": Method("se3_wrist", label="DP-EE-Wrist", group=_WRIST),
    "dp_ee_proj_wrist": Method(
        "se3_wrist", projects=True, weights_of="dp_ee_wrist", label="DP-EE-Proj-Wrist", group=_WRIST
    ),
    "dp_rcm6": Method("rcm6", sees_trocar=True, label="DP-RCM-6", group=_WRIST),
    # Two heirs of STAR-Diff. By position: the network gives roll and wrist. By pose: both follow
    # exactly from the pose and the trocar.
    "stardiff_wrist": Method("rcm6", hierarchical=True, label="STAR-Diff-Wrist", group=_WRIST),
    "stardiff_pose": Method("se3_through", label="STAR-Diff-Pose", group=_WRIST),
    # Controls: generators with the trocar as input, and one model without it.
    "stardiff_wrist_told": Method(
        "rcm6", sees_trocar=True, hierarchical=True, label="STAR-Diff-Wrist-Told", group=_WRIST
    ),
    "stardiff_pose_told": Method(
        "se3_through", sees_trocar=True, label="STAR-Diff-Pose-Told", group=_WRIST
    ),
    "dp_rcm6_untold": Method("rcm6", label="DP-RCM-6-Untold", group=_WRIST),
}


def _complete(name: str, row: Method) -> Method:
    weights, label = row.weights_of or name, row.label or name
    return row._replace(weights_of=weights, label=label, group=row.group or _OTHERS)


def _rows(built_in: Mapping[str, Method]) -> Rows:
    rows = {name: _complete(name, row) for name, row in built_in.items()}
    return Rows(Registry("method", rows, "starjax.core.methods:Method"), _complete)


METHODS: Rows = _rows(_BUILT_IN)
# Rows of results: the methods, and policies of other programs, see `starjax evaluate --policy ws://`.
SERVED = "served"
SCORED: Rows = _rows(
    {
        **_BUILT_IN,
        SERVED: Method(
            action_space="se3",
            sees_trocar=True,
            projects=False,
            hierarchical=False,
            weights_of=SERVED,
            label="Served policy",
            group="Other programs",
        ),
    }
)

# Methods of `--method all`; further rows are selected by name.
TABLE_II = tuple(name for name, row in _BUILT_IN.items() if row.group in (_NAIVE, _RCM, _OURS))


def selected(text: str) -> list[str]:
    """Returns the methods of a comma-separated list, each once; `all` stands for Table II."""
    names = [TABLE_II if name == "all" else (name,) for name in text.split(",")]
    return list(dict.fromkeys(name for group in names for name in group))


def behaviour(name: str) -> Method:
    """Returns a row without its names; methods with equal rows behave identically."""
    return SCORED[name]._replace(label="", group="")


def parts(name: str) -> list[sources.Identity]:
    """Returns the identity of a method and its action space, without code for those of starjax."""
    row = SCORED.get(name)
    kinds = {"method": name, "action_space": row.action_space if row else ""}
    return [sources.identity(Registry(kind, {}), part) for kind, part in kinds.items()]
