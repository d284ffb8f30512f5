"""One model for the whole action: every method but the hierarchical ones."""

from typing import Any, NamedTuple

import jax

from starjax import rcm
from starjax.core import config, methods
from starjax.data import normalizer, windows
from starjax.policies import acting, execution, features, generator
from starjax.policies.base import Params, Policy


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
            features.encode_proprioception(
                stats, method.action_space, batch.observation, batch.trocar, wrist
            ),
        )
        trocar_condition = features.trocar_condition(method, batch.trocar)
        return PreparedActions(inputs, trocar_condition, model.prepare(key_model, x0))

    def loss(params: Params, prepared: PreparedActions) -> tuple[jax.Array, dict[str, jax.Array]]:
        condition = networks.observe(params, prepared.inputs, prepared.trocar_condition)
        return model.loss(params["learner"], condition, prepared.model_inputs)

    def decode(params, stats, x0, measured, condition, trocar):
        return execution.command(method, stats, x0, trocar, wrist)

    sample, generate, execute = acting.make(method, policy_config, sensors, networks, wrist, decode)
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
