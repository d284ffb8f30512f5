"""Behaviour cloning: an MLP predicts the whole sequence at once, the baseline of the others.

Not in the paper. Sources: `models.regression`.
"""

import dataclasses
from typing import TYPE_CHECKING

from starjax.core import config
from starjax.core.learners import Learner
from starjax.core.limits import Count, Positive

if TYPE_CHECKING:  # it imports jax, which `--help` does without
    from starjax.policies.sequences import SequenceModel, Sizes


@dataclasses.dataclass(frozen=True, kw_only=True)
class BcConfig:
    """Options of the learner `bc`."""

    mlp_width: Count = 1024  # width of the MLP's hidden layers
    mlp_blocks: Count = 3  # residual blocks of two layers
    # sequences that it says, of which one is drawn; 1: plain regression
    components: Count = 1
    # standard deviation of actions in a component, normalised units; without effect on one
    component_spread: Positive = 0.1


def check(options: BcConfig, policy_config: config.PolicyConfig) -> None:
    """Accepts all combinations of options."""


def make(options: BcConfig, policy_config: config.PolicyConfig, sizes: "Sizes") -> "SequenceModel":
    """Builds the model of these options."""
    import jax
    import jax.numpy as jnp

    from starjax.policies import sequences
    from starjax.policies.models import diffusion, kernels, regression
    from starjax.policies.sequences import Condition, Params

    dtype = jnp.dtype(policy_config.dtype)
    network = regression.MixtureNet(
        horizon=sizes.horizon,
        action_dim=sizes.action,
        components=options.components,
        width=options.mlp_width,
        blocks=options.mlp_blocks,
        dtype=dtype,
    )

    apply = kernels.applied(network)

    def init(key: jax.Array) -> Params:
        return {"mixture": network.init(key, jnp.zeros((1, sizes.condition)))}

    def loss(params: Params, condition: Condition, x0: jax.Array) -> tuple[jax.Array, dict]:
        said = apply(params["mixture"], sequences.condition_vector(condition))
        return regression.loss(said, x0, options.component_spread), {}

    def sample(
        params: Params, keys: jax.Array, condition: Condition, reach: jax.Array | None
    ) -> jax.Array:
        said = apply(params["mixture"], sequences.condition_vector(condition))
        return diffusion.within(regression.draw(said, keys), reach)

    def cast_params(params: Params) -> Params:
        return sequences.cast_params(params, {"kernel"}, dtype)

    def prepare_for_inference(params: Params) -> Params:
        return {"mixture": kernels.packed(cast_params(params["mixture"]))}

    return sequences.SequenceModel(
        init, lambda key, x0: x0, loss, sample, cast_params, prepare_for_inference
    )


LEARNER = Learner(BcConfig, check, make)
