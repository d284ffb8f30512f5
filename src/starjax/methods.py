"""Methods as data: the eight of Table II and further rows. Standard library only."""

from typing import NamedTuple


class Method(NamedTuple):
    """A row of Table II, or a further one.

    Attributes:
      action_space: key of `starjax.rcm.ACTION_SPACES`.
      sees_trocar: the learner's model is conditioned on the trocar; the roll network always is.
      projects: poses are projected onto the RCM manifold at execution.
      hierarchical: the learner for (position, gripper) and a network for the roll, else one model.
      weights_of: the method whose weights it shares (its own name if it trains its own).
      label: name in tables.
      group: group in Tables II and III; further rows have another.
    """

    action_space: str
    sees_trocar: bool = False
    projects: bool = False
    hierarchical: bool = False
    weights_of: str = ""
    label: str = ""
    group: str = ""

    @property
    def keeps_to_manifold(self) -> bool:
        """True if executed poses are on the RCM manifold."""
        return self.projects or self.action_space != "se3"


_NAIVE, _RCM, _OURS = "Naive", "RCM action spaces", "Ours"
_BESIDE = "Ours (ablation)"

METHODS: dict[str, Method] = {
    "dp_ee": Method("se3", weights_of="dp_ee", label="DP-EE", group=_NAIVE),
    "dp_ee_proj": Method(
        "se3", projects=True, weights_of="dp_ee", label="DP-EE-Proj", group=_NAIVE
    ),
    "dp_rcm1": Method("rcm1", sees_trocar=True, weights_of="dp_rcm1", label="DP-RCM-1", group=_RCM),
    "dp_rcm2": Method("rcm2", sees_trocar=True, weights_of="dp_rcm2", label="DP-RCM-2", group=_RCM),
    "dp_rcm3": Method("rcm3", sees_trocar=True, weights_of="dp_rcm3", label="DP-RCM-3", group=_RCM),
    "dp_rcm4": Method("rcm4", sees_trocar=True, weights_of="dp_rcm4", label="DP-RCM-4", group=_RCM),
    # Table II's own note: STAR-Diff-Single and DP-RCM-4 are one model, listed in both groups.
    "stardiff_single": Method(
        "rcm4", sees_trocar=True, weights_of="dp_rcm4", label="STAR-Diff-Single", group=_OURS
    ),
    "stardiff": Method(
        "rcm4", hierarchical=True, weights_of="stardiff", label="STAR-Diff", group=_OURS
    ),
    # By Proposition 1 the position model needs no trocar; this one is conditioned on it too.
    "stardiff_told": Method(
        "rcm4",
        sees_trocar=True,
        hierarchical=True,
        weights_of="stardiff_told",
        label="STAR-Diff-Told",
        group=_BESIDE,
    ),
}

# Rows of results: the methods, and policies of other programs, see `starjax evaluate --policy ws://`.
SERVED = "served"
SCORED: dict[str, Method] = {
    **METHODS,
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

# Methods of `--method all`; further rows are selected by name.
TABLE_II = tuple(name for name, row in METHODS.items() if row.group in (_NAIVE, _RCM, _OURS))


def behaviour(name: str) -> Method:
    """Returns a row without its names; methods with equal rows behave identically."""
    return SCORED[name]._replace(label="", group="")
