"""Variants of the add-on. Imports neither jax nor the add-on."""

from starjax.core.extensions import AddOn

_HERE = "starjax.addons.decisions"
TABLE = AddOn(
    "decisions for one or a few robots in fewer GPU kernels",
    parts={
        "variant": {
            "convolve": f"{_HERE}.few_images:convolution",  # products of one or two images
            "ddim_sample": f"{_HERE}.parallel_ddim:ddim_sample",  # steps side by side
            "fuse_unet": f"{_HERE}.sampling_unet:prepared",  # a U-Net's block in two kernels
        }
    },
)
