"""Pixels of both marks of needle drive, by camera, before and during the drive.

    python experiments/needle_drive/marks.py

The expert drives a needle through each of the twelve trocars. Every fourth control step is drawn by
each camera, at the size of the packaged policies' images. No time.
"""

import functools
import pathlib
import sys

sys.path.append(str(pathlib.Path(__file__).parents[2] / "benchmarks"))
import _timing
import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm, runtime
from starjax.sim import env as envs
from starjax.sim import physics, render

TASK, CAMERAS, SIZE = "needle_drive", ("camera", "camera_near"), 128  # pixels
STEPS, EVERY, SEED = 240, 4, 2026  # control steps


def main() -> None:
    runtime.prepare_xla()
    env = envs.make(TASK, observation="state")
    trocars = jax.tree.map(jnp.asarray, env.task.trocars)
    keys = jax.random.split(jax.random.key(SEED), len(trocars.radius))
    qpos, inside, goes_on, *still = jax.jit(jax.vmap(functools.partial(episode, env)))(
        keys, trocars
    )
    results = {}
    for camera in CAMERAS:
        found = np.asarray(jax.jit(jax.vmap(functools.partial(counts, env, camera)))(qpos, *still))
        results[camera] = {
            phase: {
                mark: {"pixels": found[now, i].mean(), "hidden": (found[now, i] == 0).mean()}
                for i, mark in enumerate(("entry", "exit"))
            }
            for phase, now in (("before", goes_on & ~inside), ("inside", goes_on & inside))
        }
        print(camera, results[camera])
    about = {"scene": env.names._asdict(), "seed": SEED, "image_size": SIZE, "results": results}
    print("written to", _timing.write("marks", about))


def episode(env: envs.Env, key: jax.Array, trocar: rcm.Trocar) -> tuple:
    """Returns coordinates, needle inside and episode unfinished `[T]`, trocar and layout."""
    agent, (key_env, key_agent) = env.task.expert(), jax.random.split(key)
    state = env.reset(key_env, envs.EnvParams(trocar))

    def advance(carry: tuple, _: None) -> tuple:
        state, memory = carry
        command, memory, _ = agent.act(memory, state)
        now = state.coordinates, state.measurements.is_inside, ~state.done
        return (env.step(state, command), memory), now

    carry = state, agent.init(key_agent, state)
    _, rows = jax.lax.scan(advance, carry, None, length=STEPS)
    rows = jax.tree.map(lambda row: row[::EVERY], rows)
    return *rows, state.trocar.p_world_trocar, state.layout


def counts(env: envs.Env, camera: str, qpos: jax.Array, p_trocar: jax.Array, layout) -> jax.Array:
    """Returns the pixels `[T, 2]` of both marks."""
    m = env.scene.mj_model
    draw = render.make(m, camera, SIZE, SIZE, segmentation=True)
    marks = jnp.array([m.geom("entry").id, m.geom("exit").id])

    def count(row: jax.Array) -> jax.Array:
        data = physics.kinematics(env.scene, row, p_trocar, layout)
        image = draw(data.geom_xpos, data.geom_xmat, jnp.asarray(env.scene.geom_rgb))
        return (image.segmentation[..., None] == marks).sum((0, 1))

    return jax.lax.map(count, qpos)


if __name__ == "__main__":
    main()
