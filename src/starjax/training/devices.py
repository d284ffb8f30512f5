"""The mesh of devices that the batch is split over; all else has a copy on each device."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from starjax.core import errors
from starjax.core.types import Tree
from starjax.runtime import processes, xla

AXIS = "batch"
# XLA's options for a step on several GPUs: all matrices are gathered during the encoder's forward
# pass, gradients are summed in pieces of 128 MB during the backward pass.
_OVERLAP: dict[str, Any] = {
    "xla_gpu_enable_latency_hiding_scheduler": True,
    "xla_gpu_all_reduce_combine_threshold_bytes": 128 << 20,
    "xla_gpu_all_gather_combine_threshold_bytes": 1 << 30,
    "xla_gpu_reduce_scatter_combine_threshold_bytes": 128 << 20,
}


def make_mesh(batch_size: int, devices: Sequence[jax.Device] | None = None) -> Mesh:
    """Makes a mesh of the given devices (default: all), or of as many as divide the batch.

    Raises:
      UsageError: there are several processes, and all of their devices do not divide the batch.
    """
    devices = list(jax.devices() if devices is None else devices)
    count = max(n for n in range(1, len(devices) + 1) if batch_size % n == 0)
    if jax.process_count() > 1 and count < len(devices):
        raise errors.UsageError(
            "train.batch_size",
            f"a multiple of the {len(devices)} devices of all processes",
            batch_size,
        )
    # Auto: the compiler propagates the batch's sharding
    return jax.make_mesh((count,), (AXIS,), axis_types=(AxisType.Auto,), devices=devices[:count])


def batch_sharding(mesh: Mesh) -> NamedSharding:
    """Returns the sharding of a leading axis that is split over the devices."""
    return NamedSharding(mesh, PartitionSpec(AXIS))


def replicated(mesh: Mesh) -> NamedSharding:
    """Returns the sharding of a full copy on every device."""
    return NamedSharding(mesh, PartitionSpec())


def on_shares(function: Callable[..., Any], mesh: Mesh) -> Callable[..., Any]:
    """Runs a function on every device, of its shares of all arguments along their first axes."""
    if mesh.size == 1:
        return function
    spec = batch_sharding(mesh).spec
    return jax.shard_map(function, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)


def compiler_options(mesh: Mesh) -> dict[str, Any]:
    """Returns options of `jax.jit` for a training step on the mesh."""
    platform = mesh.devices.flat[0].platform
    if platform == "cpu":
        return xla.options_without_kinematics()
    return _OVERLAP if mesh.size > 1 and platform == "gpu" else {}


def replicate(tree: Tree, mesh: Mesh, may_alias: bool | None = False) -> Tree:
    """Copies every array to all devices of the mesh, in buffers of its own (safe to donate)."""
    return _put(tree, replicated(mesh), may_alias)


def own_rows(mesh: Mesh, count: int) -> np.ndarray:
    """Returns the rows of a batch of `count` that the devices of this process hold."""
    sharding = batch_sharding(mesh)
    spans: Any = sharding.addressable_devices_indices_map((count,)).values()
    return np.unique(np.concatenate([np.arange(count)[span] for (span,) in spans]))


def shard_own(tree: Tree, mesh: Mesh, count: int) -> Tree:
    """Splits a batch of `count`, of which every process has its `own_rows`, over the devices."""
    sharding = batch_sharding(mesh)
    if sharding.is_fully_addressable:
        return _put(tree, sharding, None)

    def join(x: np.ndarray) -> jax.Array:
        return jax.make_array_from_process_local_data(sharding, x, (count, *x.shape[1:]))

    return jax.tree.map(join, tree)


def _put(tree: Tree, sharding: NamedSharding, may_alias: bool | None) -> Tree:
    if sharding.is_fully_addressable:
        return jax.device_put(tree, sharding, may_alias=may_alias)
    return jax.tree.map(lambda x: processes.spread(x, sharding, may_alias), tree)
