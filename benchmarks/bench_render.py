"""Camera pictures per second, against MuJoCo's C renderer (software GL unless there is better).

    python benchmarks/bench_render.py [--sizes 256] [--batch 360]

Ours draw inside one program, as collection and evaluation do: a scan of steps over a batch of
environments, shadows on. The C renderer draws the same poses one by one in a process of its own.
The floor is the time of writing the finished pictures at the rate of a large copy; the memory of a
picture is the compiler's scratch space over the pictures that are drawn at once.
"""

import argparse
import os
import pathlib
import subprocess
import sys
import tempfile

import _machine
import _peer
import _timing
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from starjax import runtime
from starjax.sim import render
from starjax.sim import scene as scenes

GL_RENDERER = pathlib.Path(__file__).parents[1] / "tests/sim/gl_renderer.py"
SIZES = (96, 128, 256)
BATCH = {"cpu": 16, "gpu": 360}  # environments drawn at once
STEPS = 4


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES, help="side in pixels")
    parser.add_argument("--batch", type=int, default=BATCH[_peer.platform()])
    asked = parser.parse_args()
    batch = asked.batch
    runtime.prepare_xla()
    rates = _machine.measure("float32")
    scene = scenes.load(scenes.name())
    mj_model, qpos = scene.mj_model, states(scene, STEPS * batch)
    geoms = poses(mj_model, qpos, batch)
    print(f"{mj_model.ngeom} geoms, batch {batch}, pictures/s")
    print("size  starjax  C renderer  ratio  x floor  MB a picture  compile s")
    rows = {}
    for size in asked.sizes:
        time_ours = _timing.time_jitted(program(mj_model, size), *geoms)
        rate = STEPS * batch / time_ours.median_s
        peer = c_rate(mj_model, qpos[:16], size)
        floor_rate = rates.bandwidth / (3 * size**2)
        memory = (time_ours.temporary_bytes + time_ours.result_bytes / STEPS) / batch
        rows[str(size)] = {
            "batch": batch,
            "pictures_per_s": rate,
            "best_pictures_per_s": STEPS * batch / time_ours.min_s,
            "c_renderer_pictures_per_s": peer,
            "ratio_to_c_renderer": rate / peer if peer else None,
            "floor_pictures_per_s": floor_rate,
            "ratio_to_floor": floor_rate / rate,
            "bytes_a_picture": memory,
            "compile_s": time_ours.compile_s,
        }
        ratio = f"{rate / peer:6.1f}" if peer else "  none"
        print(
            f"{size:4} {rate:8.0f} {peer or 0:11.0f} {ratio} {floor_rate / rate:8.0f} "
            f"{memory / 1e6:13.2f} {time_ours.compile_s:10.1f}",
            flush=True,
        )
    path = _timing.write("render", {"geoms": mj_model.ngeom, "results": rows})
    print(f"wrote {path}")


def states(scene: scenes.Scene, n: int) -> np.ndarray:
    """`[n, nq]` configurations: the tool somewhere over the boards, the block on them."""
    rng = np.random.default_rng(0)
    qpos = np.tile(scene.mj_model.qpos0, (n, 1))
    (arm,) = scene.arms
    for joint, home in zip(arm.q, arm.home, strict=True):
        qpos[:, joint] = home + rng.normal(scale=0.05, size=n)
    block = scene.bound.block
    qpos[:, block : block + 2] = rng.uniform(-0.03, 0.03, (n, 2))
    return qpos


def poses(mj_model: mujoco.MjModel, qpos: np.ndarray, batch: int) -> tuple[jax.Array, jax.Array]:
    """Poses of all geoms, `[STEPS, batch, G, 3]` and `[STEPS, batch, G, 3, 3]`."""
    data, xpos, xmat = mujoco.MjData(mj_model), [], []
    for q in qpos:
        data.qpos[:] = q
        mujoco.mj_kinematics(mj_model, data)
        xpos.append(data.geom_xpos.copy())
        xmat.append(data.geom_xmat.copy())
    shape = (STEPS, batch, mj_model.ngeom)
    return (
        jnp.asarray(xpos, jnp.float32).reshape(*shape, 3),
        jnp.asarray(xmat, jnp.float32).reshape(*shape, 3, 3),
    )


def program(mj_model: mujoco.MjModel, size: int):
    """All steps of all environments, `[STEPS, batch, size, size, 3]` uint8."""
    take = jax.vmap(render.make(mj_model, height=size, width=size), in_axes=(0, 0, None))
    rgb = render.geom_rgb(mj_model)

    def run(xpos, xmat):
        return jax.lax.scan(lambda _, x: (None, take(*x, rgb).rgb), None, (xpos, xmat))[1]

    return run


def c_rate(mj_model: mujoco.MjModel, qpos: np.ndarray, size: int) -> float | None:
    """Pictures per second of MuJoCo's own renderer; None without GL."""
    with tempfile.TemporaryDirectory() as folder:
        files = [f"{folder}/{name}" for name in ("model.mjb", "qpos.npz", "out.npz")]
        mujoco.mj_saveModel(mj_model, files[0], None)
        np.savez(files[1], qpos=qpos)
        command = [sys.executable, str(GL_RENDERER), *files, "camera", str(size), str(size)]
        for backend in ("egl", "osmesa"):
            environment = {**os.environ, "MUJOCO_GL": backend}
            try:
                run = subprocess.run(command, env=environment, capture_output=True, timeout=60)
            except subprocess.TimeoutExpired:  # some drivers hang instead of failing
                continue
            if run.returncode == 0:
                with np.load(files[2]) as out:
                    return 1 / float(np.median(out["seconds"][1:]))
    return None


if __name__ == "__main__":
    main()
