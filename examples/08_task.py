"""Changes a task: the tip rests 15 mm above the mark of reach, with an expert for it.

A task is a record of data and pure functions of one episode. This one keeps the world of `reach`;
docs/extend/add-task.md has one with a world of its own, and its entry point.
"""

import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm, runtime

ABOVE = 0.015  # m
STEP = 0.002  # m a control step, of the expert


def main() -> None:
    runtime.prepare_xla()  # before the first jax array, or physics on a CPU is slow
    from starjax.core.types import Command
    from starjax.sim import env
    from starjax.sim import task as base
    from starjax.tasks.reach import task as reach

    def status(bound, layout, measurements) -> base.TaskStatus:
        off = jnp.linalg.norm(measurements.tip - layout.p - jnp.array([0.0, 0.0, ABOVE]))
        is_there = (off < 0.003) & (measurements.speed < reach.REST_SPEED)
        return base.TaskStatus(
            success_now=is_there,
            loose=off < 0.006,
            lost=jnp.zeros((), bool),
            stage=is_there.astype(jnp.int32),
            reward=jnp.exp(-off / 0.03),
        )

    def act(state) -> Command:
        """Returns the expert's command: a step towards the point above the mark."""
        way = state.layout.p + jnp.array([0.0, 0.0, ABOVE]) - state.pose.p[0]
        p = state.pose.p[0] + way * jnp.minimum(1.0, STEP / jnp.linalg.norm(way))
        pose, _ = rcm.ACTION_SPACES["rcm4"].decode(jnp.append(0.0, p)[None], state.measured_trocar)
        return Command(pose, jnp.ones(1))

    hover = reach.TASK._replace(status=status, settle_steps=15, time_limit_s=10.0)
    made = env.make("reach", observation="state", variant=hover)
    trocars = rcm.Trocar(*(jnp.full(1, x, jnp.float32) for x in (0.03, np.pi / 2, 0.4)))
    state = jax.jit(made.reset)(jax.random.key(0), env.EnvParams(trocars))
    step = jax.jit(lambda state: made.step(state, act(state)))
    while not state.done and state.step < 10.0 * made.control_hz:
        state = step(state)
    outcome = "success" if state.success else "no success"
    print(f"{outcome} after {float(state.step) / made.control_hz:.1f} s")


if __name__ == "__main__":
    main()
