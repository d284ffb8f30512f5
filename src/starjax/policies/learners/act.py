"""Action chunking with transformers (ACT), the field's usual comparison and the paper's [4].

Sources, and what differs from them: `models.transformer`.
"""

import dataclasses
from typing import TYPE_CHECKING, Any

from starjax.core import config, errors
from starjax.core.learners import Learner
from starjax.core.limits import Count, NotNegative

if TYPE_CHECKING:  # it imports jax, which `--help` does without
    from starjax.policies.sequences import SequenceModel, Sizes


@dataclasses.dataclass(frozen=True, kw_only=True)
class ActConfig:
    """Options of the learner `act`; with the defaults 7 million parameters."""

    style_dim: Count = 32  # numbers of the style of a sequence
    kl_weight: NotNegative = 10.0  # weight of the style's divergence beside the error, as in ACT
    width: Count = 256  # width of the transformers' tokens
    heads: Count = 8  # heads of their attention; divides the width
    mlp: Count = 1024  # width of their MLPs
    style_layers: Count = 2  # layers of the encoder of styles, which only training needs
    encoder_layers: Count = 4  # between the tokens of what is observed
    decoder_layers: Count = 2  # between the actions


def check(options: ActConfig, policy_config: config.PolicyConfig) -> None:
    """Raises UsageError for the first option that does not go with another."""
    if options.width % options.heads:
        expected = f"a multiple of policy.heads = {options.heads}"
        raise errors.UsageError("policy.width", expected, options.width)


def make(options: ActConfig, policy_config: config.PolicyConfig, sizes: "Sizes") -> "SequenceModel":
    """Builds the model of these options."""
    import jax
    import jax.numpy as jnp

    from starjax.policies import sequences
    from starjax.policies.models import diffusion, kernels, transformer
    from starjax.policies.sequences import Condition, Params

    dtype = jnp.dtype(policy_config.dtype)
    shared = {"width": options.width, "heads": options.heads, "mlp": options.mlp, "dtype": dtype}
    styles = transformer.StyleEncoder(
        features=options.style_dim, layers=options.style_layers, **shared
    )
    decoder = transformer.Decoder(
        horizon=sizes.horizon,
        action_dim=sizes.action,
        encoder_layers=options.encoder_layers,
        decoder_layers=options.decoder_layers,
        **shared,
    )
    decode = kernels.applied(decoder)

    def init(key: jax.Array) -> Params:
        key_style, key_decoder = jax.random.split(key)
        x0, state = jnp.zeros((1, sizes.horizon, sizes.action)), jnp.zeros((1, sizes.state))
        vision = jnp.zeros((1, sizes.obs_horizon, sizes.vision)) if sizes.vision else None
        observed = vision, state, jnp.zeros((1, sizes.trocar))
        return {
            "style": styles.init(key_style, x0, state),
            "decoder": decoder.init(key_decoder, jnp.zeros((1, options.style_dim)), *observed),
        }

    def prepare(key: jax.Array, x0: jax.Array) -> tuple[jax.Array, jax.Array]:
        # Noise of the style, z = mu + s eps
        return x0, jax.random.normal(key, (len(x0), options.style_dim))

    def loss(
        params: Params, condition: Condition, given: tuple[jax.Array, jax.Array]
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        x0, noise = given
        # The encoder sees the demonstration: the style explains the rest, unseen in observations.
        style: Any = styles.apply(params["style"], x0, condition.state)
        said = decode(params["decoder"], transformer.drawn(style, noise), *condition)
        # L1, KL to N(0, I)
        off, divergence = jnp.mean(jnp.abs(said - x0)), transformer.divergence(style)
        # The negative evidence bound of a conditional autoencoder: reconstruction + beta * KL.
        return off + options.kl_weight * divergence, {"l1": off, "divergence": divergence}

    def sample(
        params: Params, keys: jax.Array, condition: Condition, reach: jax.Array | None
    ) -> jax.Array:
        # The prior's mean: a decision is deterministic, as in ACT.
        z = jnp.zeros((len(keys), options.style_dim))
        return diffusion.within(decode(params["decoder"], z, *condition), reach)

    def cast_params(params: Params) -> Params:
        return sequences.cast_params(params, {"kernel"}, dtype)

    def prepare_for_inference(params: Params) -> Params:
        # Styles are for training alone
        return {"decoder": kernels.packed(cast_params(params["decoder"]))}

    metrics = ("l1", "divergence")
    return sequences.SequenceModel(
        init, prepare, loss, sample, cast_params, prepare_for_inference, metrics
    )


LEARNER = Learner(ActConfig, check, make)
