"""Metrics of a training, added up on the device between two lines of the log."""

from collections.abc import Iterable

import jax
import jax.numpy as jnp

from starjax.core import config, errors

Sums = dict[str, jax.Array]


def zeros(names: Iterable[str]) -> Sums:
    """Returns the sums of no steps; `names` are the policy's own metrics."""
    own = ("loss", "gradient_norm", "taken", "skipped")
    return {name: jnp.float32(0.0) for name in (*own, *names)}


def added(sums: Sums, values: dict[str, jax.Array], finite: jax.Array) -> Sums:
    """Adds the metrics of one step, which was taken if they are finite."""
    after = {name: sums[name] + jnp.where(finite, values[name], 0.0) for name in values}
    after["taken"] = sums["taken"] + jnp.where(finite, 1.0, 0.0)
    after["skipped"] = sums["skipped"] + jnp.where(finite, 0.0, 1.0)
    return after


def restarted(sums: Sums) -> Sums:
    """Returns zeros, placed as the sums are: another placement would be another program."""
    return jax.tree.map(lambda x: jax.device_put(jnp.zeros_like(x), x.sharding), sums)


def means(
    sums: Sums, step: int, skipped: int, train_config: config.TrainConfig
) -> dict[str, float]:
    """Returns the means over the steps that were taken, and how many were skipped.

    Args:
      sums: since the last line of the log.
      step: steps so far.
      skipped: of all of them.
      train_config: has the number of steps between two lines.

    Raises:
      errors.UsageError: nothing was finite in a whole stretch. A single step says nothing, as where
        the training's end cuts a stretch short.
    """
    values = {name: float(value) for name, value in sums.items()}
    taken, here = int(values.pop("taken")), int(values.pop("skipped"))
    if taken == 0 and (here >= max(train_config.log_every, 2) or 1 < step == skipped):
        raise errors.UsageError(
            "train.learning_rate",
            "one at which losses stay finite",
            f"{train_config.learning_rate:g}, none finite in {here} steps before step {step}",
            "lower it, or use policy.dtype float32",
        )
    values = {name: value / taken for name, value in values.items()} if taken else {}
    return {**values, "skipped": here}
