"""One mesh of devices: the batch is split over it, everything else is on all of them."""

from collections.abc import Sequence
from typing import Any

import jax
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

_AXIS = "batch"


def make_mesh(batch_size: int, devices: Sequence[jax.Device] | None = None) -> Mesh:
    """A mesh of the given devices (all of them by default), or of as many as divide the batch."""
    devices = list(jax.devices() if devices is None else devices)
    count = max(n for n in range(1, len(devices) + 1) if batch_size % n == 0)
    # Auto: the compiler propagates the batch's sharding; gradients meet in one all-reduce
    return jax.make_mesh((count,), (_AXIS,), axis_types=(AxisType.Auto,), devices=devices[:count])


def batch_sharding(mesh: Mesh) -> NamedSharding:
    """Leading axis split over the devices."""
    return NamedSharding(mesh, PartitionSpec(_AXIS))


def replicated(mesh: Mesh) -> NamedSharding:
    """A full copy on every device."""
    return NamedSharding(mesh, PartitionSpec())


def replicate(tree: Any, mesh: Mesh) -> Any:
    """Copies every array to all devices of the mesh, in buffers of its own (safe to donate)."""
    return jax.device_put(tree, replicated(mesh), may_alias=False)


def shard_batch(tree: Any, mesh: Mesh) -> Any:
    """Splits the leading axis of every array over the devices."""
    return jax.device_put(tree, batch_sharding(mesh))
