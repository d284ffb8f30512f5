"""No time: action error on held-out episodes of recordings that are not simulated here.

    python benchmarks/held_out.py OUT [--dataset DIR --map NAME --task TASK] [--steps 1500]

Without `--dataset` it is a stand-in in the columns of Open-H's endoscope set: a straight tool
guided to drawn targets through a wall that yields, so shafts pass the recorded trocar at some
tenths of a mm. Commands are the next poses. Each method trains on all but eight episodes.
"""

import argparse
import json
import pathlib
import subprocess
import sys

import _timing
import numpy as np
from scipy.spatial import transform

from starjax import runtime
from starjax.addons.formats import base
from starjax.addons.formats.base import Column, Source

HZ, STEPS, EPISODES, TROCARS = 30, 150, 64, 8
YIELD = 3e-4  # m, standard deviation of the wall's offset in an episode
METHODS = ("dp_ee", "dp_rcm4", "stardiff")  # free poses; on the manifold; the hierarchy
_TRAINING = (
    *("--train.batch-size", "64", "--train.learning-rate", "2e-3", "--train.warmup-steps", "100"),
    *("--train.holdout-demos", "8"),
)
_BASE = np.array([0.45, 0.1, 0.35])  # m, the trocars' place in the robot's frame
_MAP = """
task = "reach"
place = "trocar"
state = "observation.target"
[[arms]]
position = "observation.state[21:24]"
rotation = "observation.state[24:28]"
trocar = "observation.state[31:34]"
"""


def stand_in() -> Source:
    """Returns recordings in a robot's frame; `observation.target` is where each tip goes."""
    random = np.random.default_rng(0)
    frame = transform.Rotation.from_rotvec([0.3, -1.1, 0.5])
    trocars = _BASE + frame.apply(random.uniform(-0.02, 0.02, (TROCARS, 3)))
    found = [_episode(random, frame, trocars[i % TROCARS]) for i in range(EPISODES)]
    columns = {name: Column(x.shape[1:], "float32") for name, x in found[0].items()}

    def read(episode: int, names) -> dict[str, np.ndarray]:
        return {name: found[episode][name].astype(np.float32) for name in names}

    return Source(HZ, [STEPS] * EPISODES, columns, read, task="guide the endoscope")


def _episode(random, frame, trocar) -> dict[str, np.ndarray]:
    ends = random.uniform([-0.04, -0.04, -0.14], [0.04, 0.04, -0.09], (2, 3))
    s = np.clip(np.linspace(0.0, 1.3, STEPS), 0.0, 1.0)[:, None]
    p = ends[0] + (10 * s**3 - 15 * s**4 + 6 * s**5) * (ends[1] - ends[0])  # minimum jerk
    slow = np.cumsum(random.normal(size=(STEPS, 3)), axis=0)
    wall = YIELD * (slow - slow.mean(axis=0)) / slow.std(axis=0)
    z = (p - wall) / np.linalg.norm(p - wall, axis=-1, keepdims=True)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    R = frame * transform.Rotation.from_matrix(np.stack([x, np.cross(z, x), z], -1))
    state = np.zeros((STEPS, 35))
    state[:, 21:24], state[:, 24:28], state[:, 31:34] = trocar + frame.apply(p), R.as_quat(), trocar
    target = np.tile(trocar + frame.apply(ends[1]), (STEPS, 1))
    return {"observation.state": state, "observation.target": target}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("--dataset", type=pathlib.Path, help="a recording, of any format")
    parser.add_argument("--map", default="", help="its mapping")
    parser.add_argument("--task", default="reach", help="of the mapping")
    parser.add_argument("--steps", type=int, default=1500, help="of training")
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    dataset, mapping = asked.dataset, asked.map
    if dataset is None:
        dataset, mapping = asked.out / "stand-in", str(asked.out / "map.toml")
        pathlib.Path(mapping).write_text(_MAP)
        if not dataset.exists():
            base.FORMATS.get("lerobot-v2.1").write(dataset, stand_in(), False)
    demos = asked.out / "demos"
    if not (demos / "SEALED.json").exists():
        given = ["--map", mapping] if mapping else []
        starjax("import", dataset, demos, *given, "--accept")
    sees = "state" if asked.dataset is None else "image"
    given = ["--preset", "smoke", "--policy.learner", "flow", "--task", asked.task]
    given += ["--demos.from", demos, "--out", asked.out / "run", "--policy.observation", sees]
    given += ["--train.steps", asked.steps, "--train.checkpoint-every", asked.steps]
    given += ["--train.log-every", "100", "--train.steps-per-call", "20", *_TRAINING]
    rows = {}
    for method in METHODS:
        starjax("train", "--method", method, *given)
        log = (asked.out / "run" / method / "metrics.jsonl").read_text().splitlines()
        last = [row for row in map(json.loads, log) if row["kind"] == "holdout"][-1]
        rows[method] = {name: x for name, x in last.items() if name.endswith(("_mm", "_deg"))}
        print(method, rows[method], flush=True)
    if asked.dataset is None:
        runtime.prepare_xla()
        about = {"episodes": EPISODES, "held_out": 8, "steps": asked.steps, "wall_mm": 1e3 * YIELD}
        _timing.write("held_out", {**about, "results": rows})


def starjax(*arguments) -> None:
    """Runs a command of starjax."""
    subprocess.run([sys.executable, "-m", "starjax", *map(str, arguments)], check=True)


if __name__ == "__main__":
    main()
