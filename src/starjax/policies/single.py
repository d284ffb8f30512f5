"""One diffusion model for the whole action: every row of Table II but the hierarchical one."""

from typing import Any, NamedTuple

import jax

from starjax import config, methods, rcm
from starjax.data import normalizer, windows
from starjax.models import diffusion
from starjax.policies import diffuser, execution, features
from starjax.policies.base import Params, Policy
from starjax.sim.types import Observation
from starjax.types import Command


class Prepared(NamedTuple):
    """A batch as the loss needs it, with everything random drawn."""

    inputs: features.Inputs
    extra: jax.Array
    noised: diffusion.Noised


def make(
    method: methods.Method,
    policy_config: config.PolicyConfig,
    p_world_ref: Any,
    train_config: config.TrainConfig,
) -> Policy:
    """Diffusion over (pose in the method's action space, gripper); see `policy.make`."""
    dim = rcm.ACTION_SPACES[method.action_space].dim + 1
    task_dim = features.TASK_FEATURES if policy_config.observation == "state" else 0
    model = diffuser.make(policy_config, dim, dim + task_dim, features.extra_dim(method))

    def prepare(stats: normalizer.Normalizer, key: jax.Array, batch: windows.Batch) -> Prepared:
        key_inputs, key_diffusion = jax.random.split(key)
        x0 = features.demonstrated(stats, method.action_space, batch, p_world_ref)
        inputs = features.for_training(
            policy_config,
            train_config,
            stats,
            key_inputs,
            batch.observation,
            _proprioception(stats, batch.observation, batch.trocar),
        )
        return Prepared(inputs, _extra(batch.trocar), model.noised(key_diffusion, x0))

    def loss(params: Params, given: Prepared) -> tuple[jax.Array, dict[str, jax.Array]]:
        observed = model.observe(params, given.inputs)
        return model.loss(params, observed, given.extra, given.noised), {}

    def sample(
        params: Params,
        stats: normalizer.Normalizer,
        keys: jax.Array,
        observation: Observation,
        trocar: rcm.Trocar,
    ) -> Command:
        inputs = features.for_sampling(
            policy_config,
            train_config,
            stats,
            observation,
            _proprioception(stats, observation, trocar),
        )
        observed = model.observe(params, inputs)
        action = model.sample(params, keys, observed, _extra(trocar), stats.action.reach)
        return execution.command(method, stats, action, trocar, p_world_ref)

    def _proprioception(stats, observation, trocar):
        return features.measured(stats, method.action_space, observation, trocar, p_world_ref)

    def _extra(trocar: rcm.Trocar) -> jax.Array:
        return features.extra(method, trocar, p_world_ref)

    return Policy(model.init, prepare, loss, sample)
