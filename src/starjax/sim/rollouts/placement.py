"""One program over a batch of lanes (episodes), split over devices that never wait for others."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from starjax.core.types import ArrayTree
from starjax.runtime import precompile

SHARED = PartitionSpec()
LANE = PartitionSpec("lane")


class DeviceLayout(NamedTuple):
    """Lanes and devices of a batch.

    Attributes:
      lanes: episodes simulated together on all devices; of a CPU with one, each core has as many.
        0: chosen for the machine. It decides memory use, and may change last bits.
      devices: that lanes are split over, None for the default one.
    """

    lanes: int = 0
    devices: Sequence[jax.Device] | None = None


DEFAULT_LAYOUT = DeviceLayout()


def devices() -> list[jax.Device] | None:
    """Returns the devices that lanes are split over: this process's, or None if it has one."""
    found = jax.local_devices()
    return found if len(found) > 1 else None


def split(
    fn: Callable[..., Any],
    devices: Sequence[jax.Device] | None,
    in_specs: Sequence[Any],
    out_specs: Any,
    donate: tuple[int, ...] = (),
) -> Callable[..., Any]:
    """Compiles `fn` for the devices: each runs it on its own lanes and stops when these are done.

    Args:
      fn: acts on lanes independently; shapes inside are those of one device's share.
      devices: None for the default one.
      in_specs: SHARED or LANE (leading axis) for each argument, or for its parts.
      out_specs: the same for the result, or for its parts.
      donate: arguments whose memory may be reused.
    """
    program = precompile.Program(fn, donate_argnums=donate)
    if devices is None:
        return program
    # A program and a thread per device. One program over all of them would put a reduction
    # into every loop's condition, the solver's included; under shard_map it would not, but there
    # XLA's compiler for GPUs dies with a segmentation fault (jaxlib 0.11.2).
    mesh = Mesh(np.array(devices), ("lane",))
    shardings = jax.tree.map(
        lambda spec: NamedSharding(mesh, spec), list(in_specs), is_leaf=_is_spec
    )

    def call(*arguments: ArrayTree) -> Any:
        placed = [jax.device_put(*pair) for pair in zip(arguments, shardings, strict=True)]
        shares = [jax.tree.map(lambda x, d=device: _share(x, d), placed) for device in devices]
        # Traced here, once, and not in every thread.
        program.shapes(*shares[0])
        with ThreadPoolExecutor(len(devices)) as pool:
            parts = list(pool.map(lambda share: program(*share), shares))
        specs = jax.tree.broadcast(out_specs, parts[0], is_leaf=_is_spec)
        return jax.tree.map(lambda spec, *leaves: _joined(mesh, spec, leaves), specs, *parts)

    return call


def _share(leaf: jax.Array, device: jax.Device) -> jax.Array:
    return next(shard.data for shard in leaf.addressable_shards if shard.device == device)


def _joined(mesh: Mesh, spec: PartitionSpec, leaves: Sequence[jax.Array]) -> jax.Array:
    shape = list(leaves[0].shape)
    shape[tuple(spec).index("lane")] *= len(leaves)
    return jax.make_array_from_single_device_arrays(
        tuple(shape), NamedSharding(mesh, spec), list(leaves)
    )


def _is_spec(x: Any) -> bool:
    return isinstance(x, PartitionSpec)
