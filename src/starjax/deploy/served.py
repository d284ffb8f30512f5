"""A served policy in the environment that it is evaluated in."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from starjax import rcm
from starjax.core import config, config_json
from starjax.core.errors import UsageError
from starjax.core.types import Command, Observation
from starjax.deploy import batching, connection_pool, greeting, inputs, plain, remote_policy, wire
from starjax.policies import in_env, policy_file
from starjax.policies.base import Policy
from starjax.sim import env as sim_env
from starjax.sim import wrists
from starjax.sim.task import Task

_NEAR_M = 1e-3  # between nominal trocars of server and task


def connect(
    address: str,
    api_key: str = "",
    arms: Sequence[str] = (),
    timeout_s: float = connection_pool.TIMEOUT_S,
) -> in_env.PolicyInEnv:
    """Connects to a server and requests one plan as a test.

    Args:
      address: `ws://HOST:PORT` or `wss://HOST:PORT`.
      api_key: of the server.
      arms: robots instead of those of the greeting.
      timeout_s: of an answer.

    Raises:
      UsageError: there is no server, its greeting is incomplete, or its plan is invalid.
    """
    return attach(connection_pool.ConnectionPool(address, api_key, timeout_s), arms)


def attach(connections: Any, arms: Sequence[str] = ()) -> in_env.PolicyInEnv:
    """Returns the policy behind connections, see `connect`, after one plan as a test."""
    hello = greeting.read(connections.metadata)
    connections.widen(hello.batch)
    env = sim_env.for_policy(hello.scene, hello.settings, arms)
    spec, settings = hello.spec, hello.settings
    if spec is None:
        spec = plain.input_spec(env, settings)
        encode = functools.partial(plain.encode, spec, env.names.task.replace("_", " "))
        decode = functools.partial(plain.decode, spec, hello.action_space, env.task)
    else:
        _check_trocars(spec, env)
        encode = functools.partial(wire.encode_request, spec)
        decode = functools.partial(_decode_own, spec, settings.horizon)
    example = batching.example(spec)
    first = decode(_first_answer(connections, encode, example), example.trocar)
    horizon = len(first.gripper)
    origin = {"address": connections.address, "metadata": greeting.as_json(connections.metadata)}
    remote = remote_policy.RemotePolicy(connections, spec, horizon, encode, decode, origin)
    remote.check(first)
    execute = hello.execute or horizon
    if not settings.obs_horizon - 1 <= execute <= horizon:
        raise UsageError("greeting.execute", f"at most the {horizon} that are planned", execute)
    settings = config_json.from_dict(
        config.PolicyConfig,
        {**config_json.as_json(settings), "horizon": horizon, "execute": execute},
    )
    params: Any = np.zeros(1, bool)
    unknown: Any = None
    trained = policy_file.Trained(
        method=hello.method,
        policy=settings,
        train=config.TrainConfig(),
        params=params,
        normalizer=unknown,
        scene=env.names,
        p_world_ref=None,
        roll_zero=(),
        monitor=greeting.read_monitor(connections.metadata, execute),
    )
    policy = _policy(remote, env.task)
    return in_env.PolicyInEnv(trained, policy, env, greeting.identity(origin), remote)


def _policy(remote: remote_policy.RemotePolicy, task: Task) -> Policy:
    """Returns a policy for inference: its other functions are the server's own business.

    A wrist follows from the tips of the plans, through the measured trocars.
    """

    def untrained(*_: Any) -> Any:
        raise NotImplementedError("a served policy is trained elsewhere")

    def sample(
        done: Any, stats: Any, keys: jax.Array, observation: Observation, trocar: rcm.TrocarFrame
    ) -> Command:
        plan = remote.sample(done, stats, keys, observation, trocar)
        return wrists.through(task, plan, trocar.p_world_trocar[:, None])

    return Policy(untrained, untrained, untrained, sample)


def _first_answer(
    connections: Any,
    encode: Callable[..., dict[str, Any]],
    example: wire.Request,
) -> Any:
    key = np.asarray(jax.random.key_data(jax.random.key(0)))
    reply = connections.ask(encode(example.observation, example.trocar, key))
    if isinstance(reply, str):
        line = next(reversed([line for line in reply.splitlines() if line.strip()]), "")
        raise UsageError("--policy", "a plan of the server", f"its error: {line[:200]}")
    return reply


def _decode_own(spec: inputs.InputSpec, horizon: int, reply: Any, trocar: rcm.Trocar) -> Command:
    """Decodes a plan of `starjax serve`, whose poses need no trocar."""
    return wire.decode_reply(spec, horizon, reply)


def _check_trocars(spec: inputs.InputSpec, env: sim_env.Env) -> None:
    own = np.asarray(env.p_world_ref)
    served = np.asarray(spec.p_world_ref).reshape(-1, 3)
    if served.shape != own.shape or np.abs(served - own).max() > _NEAR_M:
        raise UsageError("greeting.asks.p_world_ref", str(own.tolist()), served.tolist())
