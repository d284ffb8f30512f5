"""Physics steps per second of a needle in the jaws, with the scene's contacts and with more.

    python benchmarks/bench_room.py [--task needle_pick] [--tiny]

MJX compiles in how many pairs of geoms are tested and how many contacts are kept. The second scene
has room for all the contacts of both pads with the wire. Both step the same states of the scripted
expert's episodes, and alternate.
"""

import argparse
import pathlib
import re
import statistics
import tempfile
import time

import _timing
import _visited
import bench_sim
import jax
import jax.numpy as jnp
import numpy as np

from starjax import runtime
from starjax.sim import assets, registries
from starjax.sim import env as envs

# Added to the scene's 4 pairs and 12 contacts: both pads touch the wire at up to 23 points.
MORE = {"max_geom_pairs": 10, "max_contact_points": 16}
BATCH, EPISODES = 16, 4


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--task", default="needle_pick")
    parser.add_argument("--tiny", action="store_true", help="a test's sizes, nothing is written")
    asked = parser.parse_args()
    runtime.prepare_xla()
    scenes = {"scene": envs.make(asked.task, observation="state"), "all": with_room(asked.task)}
    visited = _visited.moments(scenes["scene"], 1 if asked.tiny else EPISODES)
    rows = np.random.default_rng(0).integers(0, len(visited.ctrl), BATCH)
    states = jax.tree.map(lambda leaf: jnp.asarray(leaf[rows]), visited)
    runs, seconds = {}, {name: [] for name in scenes}
    for name, env in scenes.items():
        program = bench_sim.program(env.scene, _visited.starjax_step)
        runs[name] = program.lower(states).compile()
        jax.block_until_ready(runs[name](states))
    for _ in range(1 if asked.tiny else 9):
        for name, run in runs.items():
            start = time.perf_counter()
            jax.block_until_ready(run(states))
            seconds[name].append(time.perf_counter() - start)
    steps = BATCH * bench_sim.STEPS
    rates = {name: steps / statistics.median(times) for name, times in seconds.items()}
    results = {
        name: {"steps_per_s": rate, "of_scene": rate / rates["scene"]}
        for name, rate in rates.items()
    }
    print(results)
    _timing.report("room", {"task": asked.task, "results": results}, asked.tiny)


def with_room(name: str) -> envs.Env:
    """Makes the task's environment with room for `MORE`."""
    task = registries.tasks.get(name)
    text, rows = assets.path(task.mjcf).read_text(), ""
    for key, more in MORE.items():  # a name may occur once
        own = re.search(rf'<numeric name="{key}" data="(\d+)"/>', text)
        text = text.replace(own[0], "") if own else text
        rows += f'<numeric name="{key}" data="{more + int(own[1] if own else 0)}"/>'
    text = text.replace("</mujoco>", f"<custom>{rows}</custom></mujoco>")
    with tempfile.TemporaryDirectory() as folder:
        file = pathlib.Path(folder) / "scene.xml"
        file.write_text(text)
        return envs.make(name, observation="state", variant=task._replace(mjcf=str(file)))


if __name__ == "__main__":
    main()
