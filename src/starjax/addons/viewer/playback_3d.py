"""Rollouts in a 3D view: a page of its own that plays without a server."""

import importlib.util
from collections.abc import Sequence

import numpy as np

from starjax.report import compare, results, video
from starjax.report.page import Playback

_LONGEST_S = 12.0  # longest duration shown of a rollout


def record(runs: Sequence[results.Run]) -> Playback | None:
    """Records two of the video's rollouts side by side, or one; None without any or without viser.

    Raises:
      errors.UsageError: a part of their scene is unknown here.
    """
    clips = video.choose(compare.representatives(runs))
    if not clips or importlib.util.find_spec("viser") is None:
        return None
    first, last = clips[0], clips[-1]
    is_pair = last is not first and last.result.scene == first.result.scene
    clips = [first, last] if is_pair else [first]

    from starjax.addons.viewer import frame, playback
    from starjax.sim import scene

    names = first.result.scene
    model = scene.compose(names)
    rollouts = [
        frame.from_arrays(
            np.asarray(clip.rollout.qpos),
            np.asarray(clip.rollout.p_world_trocar),
            clip.rollout.p_world_tip,
            None,
            frame.colours(names, model, clip.rollout.labels),
            clip.still,
        )
        for clip in clips
    ]
    html = playback.html(model, rollouts, first.result.control_hz, _LONGEST_S)
    return Playback(html, " and ".join(map(_name, clips)))


def _name(clip: video.Clip) -> str:
    trial = clip.rollout.trial
    return f"{clip.label} through {'seen' if trial.seen else 'unseen'} trocar {trial.trocar}"
