"""A point mass in the place of the simulator, with an expert and a policy: programs of a second."""

import types
from typing import NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from starjax.sim.types import Observation

from starjax import rcm
from starjax.types import Command, Pose

P_WORLD_REF = np.array([0.0, 0.0, 0.15], np.float32)
SPEED = 0.004  # m a control step


class Physics(NamedTuple):
    """Stands for the simulator's state."""

    qpos: jax.Array


@flax.struct.dataclass
class State:
    """The fields of `sim.env.EnvState` that others read."""

    sim: Physics
    trocar: rcm.Trocar
    source: jax.Array
    target: jax.Array
    goal: jax.Array
    step: jax.Array
    done: jax.Array
    success: jax.Array
    loose: jax.Array
    invalid: jax.Array
    collided: jax.Array
    rcm_error: jax.Array
    rcm_error_within: jax.Array
    pose: Pose
    gripper: jax.Array


class Env(NamedTuple):
    """The fields of `sim.env.Env` that others use."""

    reset: object
    step: object
    observe: object
    p_world_ref: np.ndarray
    model: object
    control_hz: float


def make_env(observation: str = "state", unlucky: float = 0.25) -> Env:
    """The tip must reach a goal; one episode in `1 / unlucky` ends invalid on the way."""

    def reset(key, params):
        key_goal, key_luck, key_peg = jax.random.split(key, 3)
        goal = jax.random.uniform(key_goal, (3,), minval=-0.05, maxval=0.05)
        fate = jnp.where(jax.random.uniform(key_luck) < unlucky, 5.0, jnp.inf)
        p = jnp.array([0.0, 0.0, 0.02])
        no = jnp.zeros((), bool)
        return State(
            sim=Physics(jnp.concatenate([p, fate[None]])),
            trocar=params.trocar,
            source=jax.random.randint(key_peg, (), 0, 6),
            target=jax.random.randint(key_peg, (), 6, 12),
            goal=goal,
            step=jnp.zeros((), jnp.int32),
            done=no,
            success=no,
            loose=no,
            invalid=no,
            collided=no,
            rcm_error=jnp.zeros(()),
            rcm_error_within=jnp.zeros(()),
            pose=Pose(jnp.eye(3), p),
            gripper=jnp.ones(()),
        )

    def step(state, command):
        delta = command.pose.p - state.pose.p
        p = state.pose.p + delta * jnp.minimum(
            1.0, SPEED / jnp.maximum(jnp.linalg.norm(delta), 1e-9)
        )
        success = jnp.linalg.norm(p - state.goal) < 0.004
        invalid = state.step.astype(jnp.float32) >= state.sim.qpos[3]
        after = state.replace(
            sim=Physics(state.sim.qpos.at[:3].set(p)),
            step=state.step + 1,
            success=success & ~invalid,
            loose=state.loose | (jnp.linalg.norm(p - state.goal) < 0.008),
            invalid=invalid,
            done=success | invalid,
            collided=state.collided | (p[2] < -0.03),
            rcm_error=0.1 * jnp.linalg.norm(delta),
            rcm_error_within=0.2 * jnp.linalg.norm(delta),
            pose=Pose(command.pose.R, p),
            gripper=command.gripper,
        )
        return jax.tree.map(lambda old, new: jnp.where(state.done, old, new), state, after)

    def observe(state):
        image = low = None
        if observation == "image":
            pixels = jnp.concatenate([state.pose.p, state.goal]) * 1000 + 128
            image = jnp.broadcast_to(pixels[:, None, None], (6, 6, 3)).astype(jnp.uint8)
        else:
            low = jnp.concatenate([state.goal, jnp.zeros(6), state.goal])
        return Observation(state.pose, state.gripper, image, low)

    return Env(reset, step, observe, P_WORLD_REF, types.SimpleNamespace(), 30.0)


class Expert(NamedTuple):
    """Walks to the goal, with noise from its key."""

    init: object = staticmethod(lambda key, state: key)
    act: object = staticmethod(lambda key, state: _act(key, state))


def _act(key, state):
    key, key_noise = jax.random.split(key)
    noise = 0.002 * jax.random.normal(key_noise, (3,))
    delta = state.goal + noise - state.pose.p
    p = state.pose.p + delta * jnp.minimum(1.0, SPEED / jnp.maximum(jnp.linalg.norm(delta), 1e-9))
    return Command(Pose(state.pose.R, p), jnp.ones(())), key


class Policy(NamedTuple):
    """The fields of `policies.policy.Policy` that an evaluation uses."""

    sample: object


def make_policy(horizon: int = 6, width: int = 64) -> tuple[Policy, object]:
    """A network with noise from the keys, steering to the goal that it sees; and its parameters."""
    keys = jax.random.split(jax.random.key(7), 2)
    params = [
        0.3 * jax.random.normal(keys[0], (26, width)),
        0.0005 * jax.random.normal(keys[1], (width, 3)),
    ]

    def sample(params, normalizer, keys, observation, trocar):
        count, seen = observation.gripper.shape
        noise = jax.vmap(lambda key: jax.random.normal(key, (2,)))(keys)
        flat = observation.state.reshape(count, 12 * seen)
        hidden = jnp.tanh(jnp.concatenate([flat, noise], -1)[:, :26] @ params[0])
        error = hidden @ params[1] * normalizer
        last = jax.tree.map(lambda x: x[:, -1], observation)
        ahead = jnp.arange(1, horizon + 1, dtype=jnp.float32)[:, None]
        delta = (last.state[:, :3] + error - last.pose.p)[:, None]
        far = jnp.linalg.norm(delta, axis=-1, keepdims=True)
        p = last.pose.p[:, None] + delta * jnp.minimum(1.0, SPEED * ahead / jnp.maximum(far, 1e-9))
        R = jnp.broadcast_to(last.pose.R[:, None], (count, horizon, 3, 3))
        return Command(Pose(R, p), jnp.ones((count, horizon)))

    return Policy(sample), params
