"""Networks, schedules and samplers trace in every strict mode that a host program may set."""

import contextlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax.policies.models import diffusion, encoders, kernels, roll_net, schedule, unet1d
from starjax.policies.models.kernels import packed_params

pytestmark = pytest.mark.slow
parallel_ddim, sampling_unet = (
    pytest.importorskip(f"starjax.addons.decisions.{name}")
    for name in ("parallel_ddim", "sampling_unet")
)

MODES = {
    "promotion": lambda: (jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise")),
    "double precision": lambda: (jax.enable_x64(True),),
}
KEY = jax.random.key(0)
SCHEDULE = schedule.cosine(100)
X = np.ones((3, 16, 4), np.float32)
K = np.arange(3, dtype=np.int32)
IMAGES = np.ones((3, 64, 64, 3), np.float32)


def unet(dtype):
    return unet1d.ConditionalUnet1D(
        action_dim=4, cond_dim=10, channels=(8, 16), groups=4, time_dim=16, dtype=dtype
    )


def encoder(trunk):
    return lambda dtype: encoders.make(trunk, features=16, width=16, dtype=dtype)


COND = np.ones((3, 10), np.float32)
NETWORKS = {
    "unet": (unet, (X, K, COND)),
    "resnet18": (encoder("resnet18"), (IMAGES, np.ones((3, 2), np.float32))),
    "small": (encoder("small"), (IMAGES, np.ones((3, 2), np.float32))),
    "few images": (encoder("resnet18"), (IMAGES[:2],)),
    "state": (lambda dtype: encoders.StateEncoder(16, dtype), (np.ones((3, 2, 5), np.float32),)),
    "roll": (
        lambda dtype: roll_net.RollNet(width=16, embed_dim=8, dtype=dtype),
        (X[..., :3], np.ones((3, 7), np.float32), np.ones((3, 2), np.float32)),
    ),
}


def network(name, dtype):
    """A network's output and gradient."""
    make, given = NETWORKS[name]
    module, given = make(dtype), jax.tree.map(jnp.asarray, given)
    params = module.init(KEY, *given)
    return jax.value_and_grad(lambda params: module.apply(params, *given).sum())(params)


def sampled_unet(change, dtype):
    """A U-Net of parameters as a GPU's decisions take them, and the trained one's."""
    module, given = unet(dtype), jax.tree.map(jnp.asarray, (X, K, COND))
    params = module.init(KEY, *given)
    apply = kernels.applied(module)
    return apply(change(params), *given), apply(params, *given)


def samples(sampler, reach):
    noise = diffusion.sample_noise(jax.random.split(KEY, 3), (16, 4))
    return sampler(lambda x, k: x, noise, steps=10, reach=reach)


def learned():
    """A loss."""
    given = diffusion.noised(SCHEDULE, KEY, jnp.asarray(X))
    return diffusion.eps_loss(lambda x, k: x, given)


CASES = {
    **{
        f"{name} {jnp.dtype(dtype).name}": lambda name=name, dtype=dtype: network(name, dtype)
        for name in NETWORKS
        for dtype in (jnp.float32, jnp.bfloat16)
    },
    "blocks for sampling": lambda: sampled_unet(sampling_unet.prepared, jnp.bfloat16),
    "packed": lambda: sampled_unet(lambda params: packed_params.pack(params, params), jnp.bfloat16),
    "learning": learned,
    **{
        f"{sampler.__module__} {reach is None}": lambda sampler=sampler, reach=reach: samples(
            sampler, reach
        )
        for sampler in (diffusion.ddim_sample, parallel_ddim.ddim_sample)
        for reach in (None, np.array([[-1.0] * 4, [1.0] * 4], np.float32))
    },
}


@pytest.mark.parametrize("on_gpu", [False, True])
@pytest.mark.parametrize("mode", MODES)
def test_every_function_traces_to_the_same_types(mode, on_gpu, monkeypatch):
    monkeypatch.setattr(kernels, "on_gpu", lambda: on_gpu)
    for name, case in CASES.items():
        with contextlib.ExitStack() as stack:
            for setting in MODES[mode]():
                stack.enter_context(setting)
            found = jax.eval_shape(case)
        for leaf in jax.tree.leaves(found):
            assert leaf.dtype in (jnp.float32, jnp.bfloat16), (name, leaf)
