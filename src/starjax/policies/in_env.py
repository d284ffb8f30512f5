"""A policy in the environment that it acts in: a file of weights, or a server, to a batch agent."""

import contextlib
import functools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import jax

from starjax import rcm
from starjax.core import config, errors, methods
from starjax.data import normalizer
from starjax.policies import policy as policies
from starjax.policies import policy_file
from starjax.runtime import files
from starjax.sim import env as sim_env
from starjax.sim.rollouts import agent, ensemble
from starjax.sim.state import EnvState


class Server(Protocol):
    """A program that plans in the place of networks.

    Attributes:
      origin: address and greeting, JSON values.
      refused: plans that it refused or that were invalid.
      fault: the error that ended it, or None.
    """

    origin: dict[str, Any]
    refused: int
    fault: Exception | None


class PolicyInEnv(NamedTuple):
    """A policy in its environment.

    Apart from `policy_file.Trained`, the content of a file, because most users of a file (inspect,
    pack, deployment) build no simulator.

    Attributes:
      trained: settings, normaliser, and parameters as `policy.sample` takes them; `trained.method`
        is the method that runs, which may share the weights of another.
      policy: pure functions of the networks.
      env: environment with the observation of the training.
      weights: SHA-256 of the file, or of a server's policy.
      server: plans in the place of `trained.params`, which then are empty.
    """

    trained: policy_file.Trained
    policy: policies.Policy
    env: sim_env.Env
    weights: str
    server: Server | None = None

    def agent(self, average_plans: bool = False) -> agent.BatchAgent:
        """Returns the agent of a batch of episodes; see `batch_agent`."""
        trained = self.trained
        wrist = normalizer.wrist_of(methods.SCORED[trained.method], self.env.task)
        made = batch_agent(trained.method, self.policy, trained.policy, average_plans, wrist)
        if self.server is None:
            return made
        return agent.BatchAgent(*_asking_for_running(made.init, made.act), made.about)

    @contextlib.contextmanager
    def faults(self) -> Iterator[None]:
        """Raises the server's fault in place of jax's error of a failed callback."""
        try:
            yield
        except jax.errors.JaxRuntimeError:
            if self.server is None or self.server.fault is None:
                raise
            raise self.server.fault from None


@functools.lru_cache(maxsize=4)  # programs belong to the functions that they were made of
def batch_agent(
    method: str,
    policy: policies.Policy,
    settings: config.PolicyConfig,
    average_plans: bool = False,
    wrist: rcm.Wrist | None = None,
) -> agent.BatchAgent:
    """Returns the agent of a batch of episodes, whose parameters are (weights, normaliser).

    Args:
      method: key of `methods.METHODS`.
      policy: its functions.
      settings: its observation horizon and number of executed commands.
      average_plans: plan at every control step and execute the mean of all plans, as ACT does.
      wrist: that it commands, see `normalizer.wrist_of`.
    """
    if average_plans:
        keeps = normalizer.keeps_to_manifold(methods.SCORED[method])
        return ensemble.from_policy(policy.sample, settings.obs_horizon, keeps, wrist)
    return agent.from_policy(policy.sample, settings.obs_horizon, settings.execute)


@functools.lru_cache(maxsize=4)
def _asking_for_running(
    begin: Callable[..., Any], decide: Callable[..., Any]
) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Returns an agent's functions with the episodes that are over as their first parameter."""

    def init(params: Any, keys: jax.Array, state: EnvState, observe: agent.Observe) -> Any:
        return begin((state.done, None), keys, state, observe)

    def act(params: Any, memory: Any, state: EnvState, observe: agent.Observe, t: jax.Array) -> Any:
        return decide((state.done, None), memory, state, observe, t)

    return init, act


def read(file: Path, argument: str = "--policy", hint: str = "") -> policy_file.Trained:
    """Reads a policy file that a user named.

    Args:
      file: a policy.safetensors.
      argument: name of the flag or file for errors.
      hint: advice if the file is damaged.

    Raises:
      errors.UsageError: the file is damaged, of another version or of an unknown method.
    """
    try:
        trained = policy_file.load(file)
    except ValueError as error:
        raise errors.UsageError(argument, "a policy of starjax", error, hint) from error
    errors.choice(f"method of {file}", trained.method, methods.METHODS)
    return trained


def place_in_own_scene(
    file: Path, trained: policy_file.Trained, *, method: str = "", arms: Sequence[str] = ()
) -> PolicyInEnv:
    """Builds the networks of a policy file and the environment of its training.

    Args:
      file: the policy file.
      trained: its content.
      method: a method that shares the weights; by default the one that trained them.
      arms: robots instead of those of the training.
    """
    env = sim_env.for_policy(trained.scene, trained.policy, arms)
    return place(file, trained, env, method=method)


def place(
    file: Path,
    trained: policy_file.Trained,
    env: sim_env.Env,
    *,
    method: str = "",
    policy: policies.Policy | None = None,
) -> PolicyInEnv:
    """Builds the networks of a policy file for an environment.

    Args:
      file: the policy file.
      trained: its content.
      env: environment with the observation of its training.
      method: a method that shares the weights; by default the one that trained them.
      policy: its functions, if they exist already.
    """
    if method and method != trained.method:  # a monitor was calibrated with the other's plans
        trained = trained._replace(method=method, monitor=None)
    row = methods.METHODS[trained.method]
    if policy is None:
        policy = policies.make(row, trained.policy, env.task, cameras=trained.scene.cameras)
    ready = trained._replace(params=policy.prepare_for_inference(trained.params))
    return PolicyInEnv(ready, policy, env, files.sha256(file))
