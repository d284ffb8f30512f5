"""Rollouts in 3D that one can turn: a page of their own that plays without a server."""

import importlib.util
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from starjax.report import compare, results, video

_LONGEST_S = 12.0  # shown of a rollout


class Turned(NamedTuple):
    """A drawn rollout.

    Attributes:
      html: a page of its own.
      said: what stands where, for a caption.
    """

    html: str
    said: str


def record(runs: Sequence[results.Run]) -> Turned | None:
    """Two of the film's rollouts side by side, or one; None without any, or without viser."""
    shown = video.choose(compare.representatives(runs))
    if not shown or importlib.util.find_spec("viser") is None:
        return None
    first, last = shown[0], shown[-1]
    alike = last is not first and last.result.scene == first.result.scene
    pair = [first, last] if alike else [first]

    from starjax.sim import scene
    from starjax.viewer import playback, recorded

    names = first.result.scene
    model = scene.compose(names)
    rollouts = [
        recorded.frames(
            np.asarray(one.rollout.qpos),
            np.asarray(one.rollout.p_world_trocar),
            one.rollout.p_world_tip,
            None,
            recorded.colours(names, model, one.rollout.labels),
        )
        for one in pair
    ]
    html = playback.html(model, rollouts, first.result.control_hz, _LONGEST_S)
    return Turned(html, " and ".join(map(_named, pair)))


def _named(shown: video.Shown) -> str:
    trial = shown.rollout.trial
    kind = "seen" if trial.seen else "unseen"
    return f"{shown.label} through {kind} trocar {trial.trocar}"
