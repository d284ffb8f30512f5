"""Common parts of learners with a U-Net: options, their check, the model around a process."""

import dataclasses
from typing import TYPE_CHECKING, Annotated

from starjax.core import config, errors
from starjax.core.limits import Count, Range

if TYPE_CHECKING:  # they import jax, which `--help` does without
    from starjax.policies.models.process import Process
    from starjax.policies.sequences import SequenceModel, Sizes


@dataclasses.dataclass(frozen=True, kw_only=True)
class UnetConfig:
    """Options of learners that undo noise with a U-Net."""

    # channels of each level of the U-Net
    unet_channels: Annotated[tuple[int, ...], Range(1, 65_536)] = (256, 512, 1024, 2048)
    # length of the U-Net's convolutions, in commands
    kernel_size: Annotated[int, Range(1, 4_095, step=2)] = 5
    groups: Count = 8  # groups of the U-Net's GroupNorms; divides all of its channels
    # width of the embedding of the time
    time_dim: Annotated[int, Range(4, 65_536, step=2)] = 128
    # scale of a sample's first noise; lower: nearer to the likeliest
    temperature: Annotated[float, Range(0.0, 1.0)] = 1.0


def check(options: UnetConfig, policy_config: config.PolicyConfig) -> None:
    """Raises UsageError for the first option that does not go with another."""
    levels, channels = len(options.unet_channels), options.unet_channels
    if not levels:
        raise errors.UsageError("policy.unet_channels", "at least one level", channels)
    if any(width % options.groups for width in channels):
        expected = f"multiples of policy.groups = {options.groups}"
        raise errors.UsageError("policy.unet_channels", expected, channels)
    if policy_config.horizon % (halvings := 2 ** (levels - 1)):
        expected = f"a multiple of {halvings} for {levels} U-Net levels"
        raise errors.UsageError("policy.horizon", expected, policy_config.horizon)


def make(
    options: UnetConfig, policy_config: config.PolicyConfig, sizes: "Sizes", process: "Process"
) -> "SequenceModel":
    """Builds the model that inverts `process`."""
    import jax.numpy as jnp

    from starjax.policies import denoiser
    from starjax.policies.models import unet1d

    network = unet1d.ConditionalUnet1D(
        action_dim=sizes.action,
        cond_dim=sizes.condition,
        channels=tuple(options.unet_channels),
        kernel_size=options.kernel_size,
        groups=options.groups,
        time_dim=options.time_dim,
        dtype=jnp.dtype(policy_config.dtype),
    )
    return denoiser.make(network, process, sizes.horizon, options.temperature)
