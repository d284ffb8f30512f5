"""One model for the whole action: every method but the hierarchical ones."""

from typing import Any, NamedTuple

import jax

from starjax import rcm
from starjax.core import config, methods
from starjax.core.types import Command, Observation
from starjax.data import normalizer, windows
from starjax.policies import execution, features, generator, sequences
from starjax.policies.base import Params, Policy
from starjax.policies.models.diffusion import within


class PreparedActions(NamedTuple):
    """A batch as the loss needs it, with everything random drawn."""

    inputs: features.Inputs
    trocar_condition: jax.Array
    model_inputs: Any


def make(
    method: methods.Method,
    policy_config: config.PolicyConfig,
    sensors: features.Sensors,
    train_config: config.TrainConfig,
) -> Policy:
    """Builds the policy that generates poses in the action space and grippers of all arms."""
    wrist = normalizer.wrist_of(method, sensors.task)
    dim = sensors.task.arms * (rcm.action_space(method.action_space, wrist).dim + 1)
    networks = generator.make(method, policy_config, sensors, dim)
    model = networks.model

    def prepare(
        stats: normalizer.Normalizer, key: jax.Array, batch: windows.Batch
    ) -> PreparedActions:
        key_inputs, key_model = jax.random.split(key)
        x0 = features.encode_commands(stats, method.action_space, batch, wrist)
        inputs = features.training_inputs(
            policy_config,
            train_config,
            sensors,
            stats,
            key_inputs,
            batch.observation,
            _proprioception(stats, batch.observation, batch.trocar),
        )
        trocar_condition = features.trocar_condition(method, batch.trocar)
        return PreparedActions(inputs, trocar_condition, model.prepare(key_model, x0))

    def loss(params: Params, prepared: PreparedActions) -> tuple[jax.Array, dict[str, jax.Array]]:
        condition = networks.observe(params, prepared.inputs, prepared.trocar_condition)
        return model.loss(params["learner"], condition, prepared.model_inputs)

    def sample(
        params: Params,
        stats: normalizer.Normalizer,
        keys: jax.Array,
        observation: Observation,
        trocar: rcm.TrocarFrame,
    ) -> Command:
        condition = _condition(params, stats, observation, trocar)
        action = model.sample(params["learner"], keys, condition, stats.action.reach)
        return execution.command(method, stats, action, trocar, wrist)

    def generate(params, stats, keys, observation, trocar, is_limited=False):
        condition = _condition(params, stats, observation, trocar)
        reach = stats.action.reach if is_limited else sequences.UNLIMITED
        return model.sample(params["learner"], keys, condition, reach)

    def execute(params, stats, actions, observation, trocar):
        return execution.command(method, stats, within(actions, stats.action.reach), trocar, wrist)

    def _condition(params, stats, observation, trocar):
        proprioception = _proprioception(stats, observation, trocar)
        inputs = features.inference_inputs(
            policy_config, sensors, stats, observation, proprioception
        )
        return networks.observe(params, inputs, features.trocar_condition(method, trocar))

    def _proprioception(stats, observation, trocar):
        space = method.action_space
        return features.encode_proprioception(stats, space, observation, trocar, wrist)

    return Policy(
        networks.init,
        prepare,
        loss,
        sample,
        model.metrics,
        networks.cast_params,
        networks.prepare_for_inference,
        generate,
        execute,
    )
