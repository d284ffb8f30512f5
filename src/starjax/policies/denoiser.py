"""Sequence model of a U-Net and a noising process (diffusion, flow, shortcut)."""

from typing import Any

import jax
import jax.numpy as jnp

from starjax.core.types import ArrayTree
from starjax.policies import sequences
from starjax.policies.models import diffusion, kernels, unet1d
from starjax.policies.models.process import Process
from starjax.policies.sequences import Condition, Params, SequenceModel

_MATRICES = {"kernel", "film_time", "film_cond"}


def make(
    unet: unet1d.ConditionalUnet1D, process: Process, horizon: int, temperature: float
) -> SequenceModel:
    """Builds the model of a network and a process.

    Args:
      unet: predicts the target of the process.
      process: noising and sampling of sequences.
      horizon: H.
      temperature: of a sample's first noise.
    """
    apply = kernels.applied(unet)
    shape = (horizon, unet.action_dim)

    def init(key: jax.Array) -> Params:
        condition = jnp.zeros((1, unet.cond_dim))
        return {"unet": unet.init(key, jnp.zeros((1, *shape)), jnp.zeros(1, jnp.int32), condition)}

    def loss(params: Params, condition: Condition, given: ArrayTree) -> tuple[jax.Array, dict]:
        joined = sequences.condition_vector(condition)  # c, [B, C]

        def predict(
            x: jax.Array, time: jax.Array, rows: slice | jax.Array = slice(None)
        ) -> jax.Array:
            return apply(params["unet"], x, time, joined[rows])

        return process.loss(predict, given), {}  # Eq. 9 for diffusion

    def sample(
        params: Params, keys: jax.Array, condition: Condition, reach: jax.Array | None
    ) -> jax.Array:
        # Once a decision: FiLM is affine, so the condition's part is the same at every step.
        film = apply(params["unet"], sequences.condition_vector(condition), method="condition")

        def predict(x: jax.Array, film_of_time: jax.Array) -> jax.Array:
            """Predicts for `x` `[B, H, D]` at one time, or `[n, B, H, D]` at n times."""
            rows = (film + film_of_time[..., None, :]).reshape(-1, film.shape[-1])  # [n * B, F]
            found = apply(params["unet"], x.reshape(-1, *shape), rows, method="denoise")
            return found.reshape(x.shape)

        return process.sample(
            predict,
            temperature * diffusion.sample_noise(keys, shape),
            prepare=lambda times: apply(params["unet"], times, method="embed_step"),
            reach=reach,
        )

    def cast_params(params: Params) -> Any:
        return sequences.cast_params(params, _MATRICES, unet.dtype)

    def prepare_for_inference(params: Params) -> Params:
        return {"unet": kernels.packed(cast_params(kernels.fused_unet(params["unet"])))}

    return SequenceModel(init, process.noised, loss, sample, cast_params, prepare_for_inference)
