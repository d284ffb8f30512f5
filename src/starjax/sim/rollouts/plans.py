"""Recording of plans and measurements next to the scores of a trial, for the runtime monitor."""

import functools

import jax
import jax.numpy as jnp

from starjax.sim.rollouts import episodes

PLANNED, AHEAD, MEASURED = "planned_p", "ahead_p", "measured_p"  # m, `[N, A, 3]`
OPENING = "measured_gripper"  # `[N, A]` in [-1 closed, +1 open]


@functools.lru_cache(maxsize=4)  # programs belong to the record that they were made of
def record(execute: int) -> episodes.Record:
    """Returns `episodes.SCORE` with the fields that `monitor.scores.of_trial` takes.

    The agent's memory must be an `agent.Plan`.

    Args:
      execute: control steps between two plans.
    """

    def fields(step: episodes.Step) -> dict[str, jax.Array]:
        plan = step.memory.command.pose.p  # [N, H, A, 3]
        index = step.before.step % execute
        later = index + execute
        has_later = (later < plan.shape[1])[:, None, None]
        return {
            **episodes.SCORE.fields(step),
            PLANNED: _at(plan, index),
            AHEAD: jnp.where(has_later, _at(plan, later), jnp.nan),
            MEASURED: step.before.pose.p,
            OPENING: step.before.gripper,
        }

    return episodes.SCORE._replace(fields=fields)


def _at(plan: jax.Array, index: jax.Array) -> jax.Array:
    """Returns the entries `[N, A, 3]` of plans `[N, H, A, 3]` at indices `[N]`."""
    last = plan.shape[1] - 1
    return jax.vmap(lambda row, i: row[jnp.minimum(i, last)])(plan, index)
