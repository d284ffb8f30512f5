"""One program over a batch of lanes (episodes), split over devices that never wait for others."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, PartitionSpec

SHARED = PartitionSpec()
LANE = PartitionSpec("lane")
TIME_LANE = PartitionSpec(None, "lane")


def devices() -> list[jax.Device] | None:
    """Devices that lanes are split over: this process's if there are several, None for one.

    Of several GPUs only the first: over four H200s with jaxlib 0.11.2 the first program that was
    split died with a segmentation fault, and the reason is not known.
    """
    found = jax.local_devices()
    return found if len(found) > 1 and found[0].platform != "gpu" else None


def split(
    fn: Callable[..., Any],
    devices: Sequence[jax.Device] | None,
    in_specs: Any,
    out_specs: Any,
    donate: tuple[int, ...] = (),
) -> Callable[..., Any]:
    """Compiles `fn` for the devices: each runs it on its own lanes and stops when these are done.

    Args:
      fn: acts on lanes independently; shapes inside are those of one device's share.
      devices: None for the default one.
      in_specs: SHARED, LANE (leading axis) or TIME_LANE (second axis) for each argument.
      out_specs: the same for the result.
      donate: arguments whose memory may be reused.
    """
    if devices is None or len(devices) == 1:
        return jax.jit(fn, donate_argnums=donate)
    # shard_map, not sharded jit: that would put a reduction over all devices into every loop's
    # condition, the solver's included. MJX's loops carry values that its check cannot follow.
    mesh = Mesh(np.array(devices), ("lane",))
    mapped = jax.shard_map(fn, mesh=mesh, in_specs=in_specs, out_specs=out_specs, check_vma=False)
    return jax.jit(mapped, donate_argnums=donate)
