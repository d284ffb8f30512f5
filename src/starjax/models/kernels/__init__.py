"""Variants of parts of the networks that are faster on one kind of device.

One file holds one variant: the reference that it equals stands in its first lines, `pays` is the
only function that decides whether it is used, and tests/models/kernels holds it to its reference.
To drop a variant, delete its file and the line that asks `pays`.

    channel_sums    gradients of biases in two sums                training on a GPU
    few_images      convolutions of one or two images as products  decisions on a GPU
    packed_params   vectors in one array, kernels turned           training and decisions on a GPU
    parallel_ddim   all DDIM steps side by side                    few robots on a GPU
    pooled_norm     GroupNorm, ReLU, max-pooling in one gradient   everywhere
    sampling_unet   a U-Net block in two kernels                   decisions on a GPU
"""

import jax


def on_gpu() -> bool:
    """Returns whether programs are traced for a GPU.

    `jax.lax.platform_dependent` would trace both branches, and differentiate both.
    """
    return jax.default_backend() == "gpu"
