"""Every variant can be dropped: without its line of the table the reference is used."""

import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax.policies.models import kernels, process, resnet, unet1d


def normal(*shape):
    return jnp.asarray(np.random.default_rng(1).normal(size=shape), jnp.float32)


def unet_sample():
    """Samples of a small U-Net, whose parameters are prepared for inference."""
    unet = unet1d.ConditionalUnet1D(
        action_dim=4, cond_dim=10, channels=(8, 16), groups=4, time_dim=16
    )
    x, condition = normal(2, 4, 4), normal(2, 10)
    params = jax.jit(unet.init)(jax.random.key(0), x, jnp.zeros(2, jnp.int32), condition)
    apply, ready = kernels.applied(unet), kernels.packed(kernels.fused_unet(params))

    def predict(x, k):
        rows = jnp.broadcast_to(k[..., None], x.shape[:-2]).reshape(-1)
        tiled = jnp.tile(condition, (len(rows) // 2, 1))
        return apply(ready, x.reshape(-1, 4, 4), rows, tiled).reshape(x.shape)

    return process.diffusion(100, 10).sample(predict, x, prepare=lambda k: k, reach=None)


def linear_sample():
    """Samples of a linear predictor, for which few parallel steps are exact."""
    sample = process.diffusion(100, 10).sample
    return sample(lambda x, k: 0.9 * x, normal(2, 4, 4), prepare=lambda k: k, reach=None)


def encoder_gradient():
    """Output and gradients of a small ResNet for two images."""
    network, images = resnet.ResNet18(width=16), normal(2, 32, 32, 3)
    params = network.init(jax.random.key(0), images)

    def mean_square(params):
        return (kernels.applied(network)(params, images) ** 2).mean()

    return jax.value_and_grad(mean_square)(params)


WORK = {
    "ddim_sample": linear_sample,
    "fuse_unet": unet_sample,
    "pack": unet_sample,
    "convolve": encoder_gradient,
    "NormReluPool": encoder_gradient,
    "sum_of_positions": encoder_gradient,
}


@pytest.mark.parametrize("part", kernels.VARIANTS)
@pytest.mark.release
def test_without_a_variant_the_reference_gives_the_same(part, monkeypatch):
    module = importlib.import_module(kernels.VARIANTS[part].split(":")[0])
    monkeypatch.setattr(module, "pays", lambda *size: True)
    jax.clear_caches()
    with_it = jax.tree.leaves(jax.jit(WORK[part])())
    monkeypatch.delitem(kernels.VARIANTS, part)
    jax.clear_caches()
    without = jax.tree.leaves(jax.jit(WORK[part])())
    jax.clear_caches()
    for ours, reference in zip(with_it, without, strict=True):
        scale = max(1.0, float(jnp.abs(reference).max()))
        np.testing.assert_allclose(ours, reference, atol=1e-4 * scale)


def test_every_file_is_named_by_one_line_and_nowhere_else(pytestconfig):
    source = pytestconfig.rootpath / "src/starjax"
    folders = source / "policies/models/kernels", source / "addons/decisions"
    files = {path.stem for folder in folders for path in folder.glob("*.py")}
    files -= {"__init__", "table"}
    named = [line.split(":")[0].split(".")[-1] for line in kernels.VARIANTS.values()]
    assert sorted(named) == sorted(files)
    others = [path for path in source.rglob("*.py") if path.parent not in folders]
    texts = {path: path.read_text() for path in others}
    assert not {path for path, text in texts.items() for name in files if name in text}
