"""A sealed dataset without a simulator: smooth tips through their trocars, smooth pictures."""

from pathlib import Path
from typing import Any

import fakes
import numpy as np

from starjax import rcm
from starjax.data import store
from starjax.sim import names
from starjax.sim.rollouts import episodes

CAMERAS = ("camera", "wrist")


def write(
    root: Path,
    arms: int = 1,
    size: int = 0,
    demos: int = 4,
    length: int = 30,
    cameras: int = 1,
    failures: bool = False,
    wrist: bool = False,
) -> dict[str, Any]:
    """Writes it and returns its description.

    Args:
      size: side in pixels; 0 for a dataset of task states.
      demos: successful ones; two share a trocar. One more failed, and is not kept.
      failures: the second one failed, and is kept.
      wrist: the tools are needle drivers, whose shafts move as a straight tool would.
    """
    made = fakes.dataset(0, demos, length, arms=arms)
    seen, given = made.observation, made.command
    fields = {
        "p": seen.pose.p,
        "R": seen.pose.R,
        "gripper": seen.gripper,
        "command_p": given.pose.p,
        "command_R": given.pose.R,
        "command_gripper": given.gripper,
        "qpos": np.random.default_rng(0).normal(size=(demos * length, 9)),
        "rcm_error": np.zeros((demos * length, arms)),
    }
    if wrist:
        time = np.arange(demos * length)[:, None, None]
        angles = np.broadcast_to([0.5, -0.3] * np.sin(0.1 * time), (demos * length, arms, 2))
        fields |= {"wrist": angles, "command_wrist": angles}
        fields |= {"shaft_p": seen.pose.p, "shaft_R": seen.pose.R}
        for before, shaft in (("", seen.pose), ("command_", given.pose)):
            tip = rcm.tip_of(rcm.LARGE_NEEDLE_DRIVER, shaft, angles)
            fields |= {f"{before}p": tip.p, f"{before}R": tip.R}
    fields = {name: np.asarray(field, np.float32) for name, field in fields.items()}
    if size:
        for camera in CAMERAS[:cameras]:
            fields[episodes.IMAGE + camera] = _pictures(fields["p"], size, camera)
    else:
        fields["state"] = np.asarray(seen.state, np.float32)
    trocar = [np.asarray(field, np.float64) for field in made.trocar.trocar]
    shown = CAMERAS[:cameras] if size else ()
    tool = "needle_driver" if wrist else "grasper"
    scene = names.SceneNames("peg_transfer", ("fr5",) * arms, (tool,) * arms, shown)
    slots = fakes.task(arms).slots
    description = {
        "schema": store.SCHEMA,
        "per_trocar": 2,
        "seed": 0,
        "max_steps": length,
        "keep_failures": False,
        "expert": "default",
        "scene": scene._asdict(),
        "trocars": np.stack(trocar, -1)[::2].tolist(),
        "p_world_ref": [list(slot.p_world_ref) for slot in slots],
        "roll_zero": [float(slot.roll_zero) for slot in slots],
        "control_hz": 30.0,
        "task": {"fields": [list(field) for field in fakes.TASK.fields], "labels": []},
        "features": {
            name: {"shape": list(field.shape[1:]), "dtype": field.dtype.str, "what": name}
            for name, field in sorted(fields.items())
        },
        "versions": {},
    }
    store.create(root, description)
    records = {}
    for demo in range(demos + 1):
        is_kept = demo < demos
        outcome = {
            "trocar": min(demo // 2, demos // 2 - 1),
            **{name: f[min(demo, demos - 1)].tolist() for name, f in zip(_PLACE, trocar)},
            "trial": demo % 2 if is_kept else 2,
            "seed": 0,
            "length": length,
            **dict.fromkeys(episodes.FLAGS, False),
            "success": is_kept and not (failures and demo == 1),
            "stage": 3,
            "labels": {"source": demo},
        }
        rows = slice(demo * length, (demo + 1) * length)
        arrays = {name: [fields[name][rows]] for name in sorted(fields)} if is_kept else {}
        key = store.key(outcome["trocar"], outcome["trial"], 0)
        records[key] = store.commit(root, key, outcome, arrays)
    store.seal(root, records)
    return description


_PLACE = ("radius", "polar", "azimuth")


def _pictures(p: np.ndarray, size: int, camera: str) -> np.ndarray:
    """Shades that follow the tip, `[F, size, size, 3]` uint8."""
    across = np.linspace(-1.0, 1.0, size)
    x, y = across[None, :, None], across[None, None, :]
    tip = p.reshape(len(p), -1)[:, :3, None, None] * 20.0 + 0.3 * len(camera)
    red, green, blue = (np.sin(x + tip[:, 0]), np.cos(y - tip[:, 1]), np.sin(x * y + tip[:, 2]))
    shape = (len(p), size, size)
    shades = np.stack([np.broadcast_to(shade, shape) for shade in (red, green, blue)], -1)
    return (127.5 + 100.0 * shades).astype(np.uint8)
