"""Pictures through an endoscope, whose pose each episode has its own, against the fixed camera's.

    python benchmarks/bench_endoscope.py [--sizes 128] [--batch 16]

Both draw the same scene inside one program each, as collection and evaluation do: a scan of steps
over a batch of environments, shadows on, poses a batch axis. They are timed in turns, in one
process, so the ratio means something on a busy machine. What the endoscope sees is another
picture: the third row draws the fixed camera's own picture by way of a pose.
"""

import argparse
import statistics
import time

import _peer
import _timing
import bench_render
import jax
import jax.numpy as jnp

from starjax import runtime
from starjax.sim import cameras, endoscope_camera, render
from starjax.sim import scene as scenes

TURNS = 41


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=(128,), help="side in pixels")
    parser.add_argument("--batch", type=int, default=bench_render.BATCH[_peer.platform()])
    asked = parser.parse_args()
    runtime.prepare_xla()
    scene = scenes.load(scenes.name(cameras=("camera", "endoscope")))
    m, count = scene.mj_model, bench_render.STEPS * asked.batch
    geoms = bench_render.poses(m, bench_render.states(scene, count), asked.batch)
    keys = jax.random.split(jax.random.key(0), asked.batch)
    drawn = jax.vmap(lambda key: endoscope_camera.draw(scene.task.endoscope, key))(keys)
    still = cameras.nominal(cameras.make(m, ("camera",), 32))
    held = jax.tree.map(lambda leaf: jnp.repeat(leaf, asked.batch, 0), still)
    rows = {}
    for size in asked.sizes:
        programs = {
            "fixed": compiled(bench_render.program(m, size), *geoms),
            "endoscope": compiled(through(m, "endoscope", size), *geoms, drawn),
            "fixed, as a pose": compiled(through(m, "camera", size), *geoms, held),
        }
        taken = in_turns(programs)
        best = {name: min(seconds) for name, seconds in taken.items()}
        rows[str(size)] = {
            "batch": asked.batch,
            "pictures_per_s": {name: count / seconds for name, seconds in best.items()},
            "time_over_fixed": {
                name: statistics.median(a / b for a, b in zip(seconds, taken["fixed"], strict=True))
                for name, seconds in taken.items()
            },
        }
        for name, seconds in best.items():
            ratio = rows[str(size)]["time_over_fixed"][name]
            print(f"{size:4} px  {name:18} {count / seconds:7.0f} pictures/s  {ratio:5.2f} x fixed")
    print(f"wrote {_timing.write('endoscope', {'geoms': m.ngeom, 'results': rows})}")


def through(mj_model, camera: str, size: int):
    """As `bench_render.program`, with a pose of the camera for each environment."""
    draw = render.make(mj_model, camera, size, size, moves=True)
    take, rgb = jax.vmap(draw, in_axes=(0, 0, None, 0)), render.geom_rgb(mj_model)

    def run(xpos, xmat, poses):
        return jax.lax.scan(lambda _, x: (None, take(*x, rgb, poses).rgb), None, (xpos, xmat))[1]

    return run


def compiled(function, *arguments):
    """A call of the compiled program that waits for its pictures."""
    program = jax.jit(function).lower(*arguments).compile()
    return lambda: jax.block_until_ready(program(*arguments))


def in_turns(programs) -> dict[str, list[float]]:
    """Seconds of every turn of each program."""
    taken = {name: [] for name in programs}
    for turn in range(TURNS + 1):
        for name, call in programs.items():
            start = time.perf_counter()
            call()
            if turn:  # the first warms up
                taken[name].append(time.perf_counter() - start)
    return taken


if __name__ == "__main__":
    main()
