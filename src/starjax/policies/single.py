"""One diffusion model for the whole action: every row of Table II but the hierarchical one."""

from typing import NamedTuple

import jax

from starjax import config, methods, rcm
from starjax.data import normalizer, windows
from starjax.models import diffusion
from starjax.policies import diffuser, execution, features
from starjax.policies.base import Params, Policy
from starjax.types import Command, Observation


class Prepared(NamedTuple):
    """A batch as the loss needs it, with everything random drawn."""

    inputs: features.Inputs
    extra: jax.Array
    noised: diffusion.Noised


def make(
    method: methods.Method,
    policy_config: config.PolicyConfig,
    seen: features.Sensors,
    train_config: config.TrainConfig,
) -> Policy:
    """Diffusion over (pose in the method's action space, gripper) of all arms."""
    dim = seen.task.arms * (rcm.ACTION_SPACES[method.action_space].dim + 1)
    model = diffuser.make(
        policy_config,
        dim,
        features.history_dim(policy_config, seen.task, dim),
        features.extra_dim(method, seen.task),
        len(seen.cameras),
    )

    def prepare(stats: normalizer.Normalizer, key: jax.Array, batch: windows.Batch) -> Prepared:
        key_inputs, key_diffusion = jax.random.split(key)
        x0 = features.demonstrated(stats, method.action_space, batch)
        inputs = features.for_training(
            policy_config,
            train_config,
            seen,
            stats,
            key_inputs,
            batch.observation,
            _proprioception(stats, batch.observation, batch.trocar),
        )
        extra = features.extra(method, batch.trocar)
        return Prepared(inputs, extra, model.noised(key_diffusion, x0))

    def loss(params: Params, given: Prepared) -> tuple[jax.Array, dict[str, jax.Array]]:
        observed = model.observe(params, given.inputs)
        return model.loss(params, observed, given.extra, given.noised), {}

    def sample(
        params: Params,
        stats: normalizer.Normalizer,
        keys: jax.Array,
        observation: Observation,
        told: rcm.TrocarFrame,
    ) -> Command:
        proprioception = _proprioception(stats, observation, told)
        inputs = features.for_sampling(policy_config, seen, stats, observation, proprioception)
        observed = model.observe(params, inputs)
        extra = features.extra(method, told)
        action = model.sample(params, keys, observed, extra, stats.action.reach)
        return execution.command(method, stats, action, told)

    def _proprioception(stats, observation, told):
        return features.measured(stats, method.action_space, observation, told)

    return Policy(model.init, prepare, loss, sample)
