"""Recorded trials of an evaluation for the page: its recorded.npz or invalid.npz."""

from pathlib import Path

from starjax.addons.viewer import frame as frames
from starjax.addons.viewer.browse import Recording, Recordings
from starjax.core import errors
from starjax.evaluation import recorded
from starjax.runtime import files
from starjax.sim import registries, scene
from starjax.sim.names import SceneNames
from starjax.sim.rollouts import trial_key
from starjax.sim.task import CONTROL_HZ

INVALID = "invalid.npz"


def load(file: Path) -> Recordings:
    """Reads trials with their joint positions; the plan.json next to them names the scene.

    Raises:
      errors.UsageError: the trials lack joint positions, or their task is unknown here.
      FileNotFoundError, ValueError: a file is missing or damaged; the message names it.
    """
    plan = files.read_json(file.parent / "plan.json")
    spec = plan["scene"]
    names = SceneNames(spec["task"], *(tuple(spec[part]) for part in ("arms", "tools", "cameras")))
    errors.choice("task of the trials", names.task, registries.tasks.names())
    tracks = {
        f"trocar {x.trocar}, trial {x.trial}": (x, x.qpos)
        for x in recorded.read(file)
        if x.qpos is not None
    }
    if not tracks:
        raise errors.UsageError("--trials", "trials with joint positions", file)
    model = scene.compose(names)

    def read(key: str) -> Recording:
        track, qpos = tracks[key]
        rgb = frames.colours(names, model, track.labels)
        still = trial_key.bodies_at_rest(names, plan.get("seed"), track.trocar, track.trial)
        steps = frames.from_arrays(
            qpos, track.p_world_trocar, track.p_world_tip, track.rcm_error, rgb, still
        )
        is_invalid = file.name == INVALID
        last = steps[-1]._replace(done=True, invalid=is_invalid)
        return Recording([*steps[:-1], last], None, "invalid" if is_invalid else "recorded")

    return Recordings(names, model, CONTROL_HZ, list(tracks), read)
