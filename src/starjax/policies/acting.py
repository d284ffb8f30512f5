"""Acting of a policy: a sequence of the generator, then its decoding."""

from collections.abc import Callable

import jax

from starjax import rcm
from starjax.core import config, methods
from starjax.core.types import Command, Observation
from starjax.data import normalizer
from starjax.policies import features, generator, sequences
from starjax.policies.models.diffusion import within
from starjax.policies.sequences import Condition, Params

# (params, stats, sequence [B, H, D], measured [B, O, A * (dim + 1)], Condition, trocar) -> Command
Decode = Callable[
    [Params, normalizer.Normalizer, jax.Array, jax.Array, Condition, rcm.TrocarFrame], Command
]


def make(
    method: methods.Method,
    policy_config: config.PolicyConfig,
    sensors: features.Sensors,
    networks: generator.Generator,
    wrist: rcm.Wrist | None,
    decode: Decode,
    extract: Callable[[jax.Array], jax.Array] = lambda vector: vector,
) -> tuple[Callable[..., Command], Callable[..., jax.Array], Callable[..., Command]]:
    """Returns `sample`, `generate` and `execute` of a `Policy`.

    Args:
      method, policy_config, sensors: as of the policy.
      networks: whose model generates sequences.
      wrist: that the method commands.
      decode: turns a sequence into commands.
      extract: `[..., A * (dim + 1)] -> [..., D]`, the entries that the model generates.
    """
    model = networks.model

    def sample(
        params: Params,
        stats: normalizer.Normalizer,
        keys: jax.Array,
        observation: Observation,
        trocar: rcm.TrocarFrame,
    ) -> Command:
        measured, condition = _condition(params, stats, observation, trocar)
        x0 = model.sample(params["learner"], keys, condition, _reach(stats))
        return decode(params, stats, x0, measured, condition, trocar)

    def generate(params, stats, keys, observation, trocar, is_limited=False):
        _, condition = _condition(params, stats, observation, trocar)
        reach = _reach(stats) if is_limited else sequences.UNLIMITED
        return model.sample(params["learner"], keys, condition, reach)

    def execute(params, stats, actions, observation, trocar):
        measured, condition = _condition(params, stats, observation, trocar)
        x0 = within(actions, _reach(stats))
        return decode(params, stats, x0, measured, condition, trocar)

    def _condition(params, stats, observation, trocar):
        space = method.action_space
        measured = features.encode_proprioception(stats, space, observation, trocar, wrist)
        inputs = features.inference_inputs(
            policy_config, sensors, stats, observation, extract(measured)
        )
        # Some methods alone are conditioned on the trocar.
        given = features.trocar_condition(method, trocar)
        return measured, networks.observe(params, inputs, given)

    def _reach(stats):
        return None if stats.action.reach is None else extract(stats.action.reach)

    return sample, generate, execute
