"""One model for the whole action: every method but the hierarchical ones."""

from typing import Any, NamedTuple

import jax

from starjax import config, methods, rcm
from starjax.data import normalizer, windows
from starjax.policies import execution, features, generator
from starjax.policies.base import Params, Policy
from starjax.types import Command, Observation


class Prepared(NamedTuple):
    """A batch as the loss needs it, with everything random drawn."""

    inputs: features.Inputs
    told: jax.Array
    given: Any


def make(
    method: methods.Method,
    policy_config: config.PolicyConfig,
    seen: features.Sensors,
    train_config: config.TrainConfig,
) -> Policy:
    """The policy that generates (pose in the method's action space, gripper) of all arms."""
    dim = seen.task.arms * (rcm.ACTION_SPACES[method.action_space].dim + 1)
    networks = generator.make(method, policy_config, seen, dim)
    model = networks.model

    def prepare(stats: normalizer.Normalizer, key: jax.Array, batch: windows.Batch) -> Prepared:
        key_inputs, key_model = jax.random.split(key)
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
        told = features.extra(method, batch.trocar)
        return Prepared(inputs, told, model.prepare(key_model, x0))

    def loss(params: Params, prepared: Prepared) -> tuple[jax.Array, dict[str, jax.Array]]:
        condition = networks.observe(params, prepared.inputs, prepared.told)
        return model.loss(params["learner"], condition, prepared.given)

    def sample(
        params: Params,
        stats: normalizer.Normalizer,
        keys: jax.Array,
        observation: Observation,
        told: rcm.TrocarFrame,
    ) -> Command:
        proprioception = _proprioception(stats, observation, told)
        inputs = features.for_sampling(policy_config, seen, stats, observation, proprioception)
        condition = networks.observe(params, inputs, features.extra(method, told))
        action = model.sample(params["learner"], keys, condition, stats.action.reach)
        return execution.command(method, stats, action, told)

    def _proprioception(stats, observation, told):
        return features.measured(stats, method.action_space, observation, told)

    return Policy(
        networks.init,
        prepare,
        loss,
        sample,
        model.metrics,
        networks.rounded,
        networks.for_sampling,
    )
