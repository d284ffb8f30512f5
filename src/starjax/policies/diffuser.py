"""Encoders and U-Net put together: a conditional diffusion model over `[H, D]` sequences."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from starjax import config
from starjax.models import diffusion, encoders, schedule, unet1d
from starjax.models.kernels import packed_params, parallel_ddim, sampling_unet
from starjax.policies import features

Params = dict[str, Any]


class Diffuser(NamedTuple):
    """Pure functions of one model.

    Attributes:
      init: `key -> params`, those that training changes: none for a frozen vision encoder.
      observe: `(params, inputs) -> [B, N]`, those numbers.
      noised: `(key, x0 [B, H, D]) -> Noised`, what is learned from clean sequences.
      loss: `(params, observed [B, N], extra [B, E], Noised) -> scalar` of Eq. 9.
      sample: `(params, keys [B], observed [B, N], extra [B, E], reach=None) -> [B, H, D]` by DDIM,
        within `reach` `[2, D]`, lowest and highest, or if it is None within [-1, 1].
    """

    init: Callable[[jax.Array], Params]
    observe: Callable[[Params, features.Inputs], jax.Array]
    noised: Callable[[jax.Array, jax.Array], diffusion.Noised]
    loss: Callable[[Params, jax.Array, jax.Array, diffusion.Noised], jax.Array]
    sample: Callable[..., jax.Array]


def observed_dim(policy_config: config.PolicyConfig, cameras: int) -> int:
    """N, numbers that the networks make of an observation by so many cameras."""
    images = policy_config.obs_horizon * cameras if policy_config.observation == "image" else 0
    return images * policy_config.vision_dim + policy_config.state_dim


def make(
    policy_config: config.PolicyConfig,
    action_dim: int,
    history_dim: int,
    extra_dim: int,
    cameras: int = 1,
) -> Diffuser:
    """The model of `policy_config` for vectors of D entries.

    Args:
      policy_config: networks and diffusion.
      action_dim: D.
      history_dim: width of `Inputs.history`.
      extra_dim: E, numbers appended to the condition (trocar features), possibly 0.
      cameras: K, whose images one encoder reads, one by one.
    """
    dtype = jnp.dtype(policy_config.dtype)
    sees_image = policy_config.observation == "image"
    vision = vision_encoder(policy_config)
    state = encoders.StateEncoder(features=policy_config.state_dim, dtype=dtype)
    unet = unet1d.ConditionalUnet1D(
        action_dim=action_dim,
        cond_dim=observed_dim(policy_config, cameras) + extra_dim,
        channels=tuple(policy_config.unet_channels),
        kernel_size=policy_config.kernel_size,
        groups=policy_config.groups,
        time_dim=policy_config.time_dim,
        dtype=dtype,
    )
    of_unet, of_state, of_vision = (
        packed_params.applied(apply)
        for apply in (sampling_unet.applied(unet), state.apply, vision.apply)
    )
    noise_schedule = schedule.cosine(policy_config.diffusion_steps)
    shape = (policy_config.horizon, action_dim)

    def init(key: jax.Array) -> Params:
        key_vision, key_state, key_unet = jax.random.split(key, 3)
        history = jnp.zeros((1, policy_config.obs_horizon, history_dim))
        params = {
            "state": state.init(key_state, history),
            "unet": unet.init(
                key_unet, jnp.zeros((1, *shape)), jnp.zeros(1, jnp.int32), _zeros(unet.cond_dim)
            ),
        }
        if sees_image and not policy_config.freeze_encoder:
            size = policy_config.image_size
            params["vision"] = vision.init(key_vision, jnp.zeros((1, size, size, 3)))
        return params

    def observe(params: Params, inputs: features.Inputs) -> jax.Array:
        parts: list[Any] = [of_state(params["state"], inputs.history)]
        if inputs.features is not None:
            parts.insert(0, inputs.features.reshape(len(inputs.features), -1))
        elif inputs.images is not None:
            batch, size = len(inputs.images), inputs.images.shape[3:]
            offset = inputs.offset
            seen = of_vision(
                params["vision"],
                inputs.images.reshape(-1, *size),
                None if offset is None else offset.reshape(-1, 2),
            )
            parts.insert(0, seen.reshape(batch, -1))
        return jnp.concatenate(parts, axis=-1)

    def noised(key: jax.Array, x0: jax.Array) -> diffusion.Noised:
        return diffusion.noised(noise_schedule, key, x0)

    def loss(
        params: Params, observed: jax.Array, extra: jax.Array, given: diffusion.Noised
    ) -> jax.Array:
        cond = _beside(observed, extra)
        return diffusion.eps_loss(lambda x, k: of_unet(params["unet"], x, k, cond), given)

    def sample(
        params: Params,
        keys: jax.Array,
        observed: jax.Array,
        extra: jax.Array,
        reach: jax.Array | None = None,
    ) -> jax.Array:
        cond = _beside(observed, extra)
        film = of_unet(params["unet"], cond, method="condition")

        def eps_fn(x: jax.Array, film_k: jax.Array) -> jax.Array:
            """Of `[B, H, D]` at one step, or of `[steps, B, H, D]`."""
            rows = (film + film_k[..., None, :]).reshape(-1, film.shape[-1])
            eps = of_unet(params["unet"], x.reshape(-1, *shape), rows, method="denoise")
            return eps.reshape(x.shape)

        steps = policy_config.ddim_steps
        ddim = parallel_ddim if parallel_ddim.pays(len(keys), steps) else diffusion
        return ddim.ddim_sample(
            eps_fn,
            policy_config.temperature * diffusion.sample_noise(keys, shape),
            diffusion_steps=policy_config.diffusion_steps,
            steps=steps,
            prepare=lambda k: of_unet(params["unet"], k, method="embed_step"),
            reach=reach,
        )

    return Diffuser(init, observe, noised, loss, sample)


def vision_encoder(policy_config: config.PolicyConfig) -> encoders.ImageEncoder:
    """The network that reads images, whose parameters are `params["vision"]`."""
    return encoders.ImageEncoder(
        trunk=policy_config.encoder,
        features=policy_config.vision_dim,
        dtype=jnp.dtype(policy_config.dtype),
    )


def _beside(observed: jax.Array, extra: jax.Array) -> jax.Array:
    """What the U-Net is told."""
    # XLA of jax 0.11 crashes on an empty array that is concatenated under `shard_map`
    return jnp.concatenate([observed, extra], axis=-1) if extra.shape[-1] else observed


def _zeros(width: int) -> jax.Array:
    return jnp.zeros((1, width))
