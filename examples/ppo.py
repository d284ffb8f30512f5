"""Learns a task by proximal policy optimisation; an iteration is one compiled program.

    python examples/ppo.py                                               # a CPU
    python examples/ppo.py --envs 4096 --iterations 60 --minibatches 32   # a GPU

Needs optax and flax beside jax and mujoco-mjx. Prints one JSON object a line: the curve, with how
often the mean action succeeds.

The noise is small, and the network says how large it is where. The controller bounds acceleration:
under large noise steps hit that bound whatever the mean is, so a policy that leaps to and fro over
the goal loses nothing by it, and does not learn to rest there.
"""

import argparse
import json
import time
from functools import partial

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax

from starjax import runtime

GAMMA, LAMBDA, CLIP = 0.9, 0.95, 0.2
EPOCHS = 4
LENGTH = 32  # control steps of an iteration
EPISODE = 150  # control steps at most while it learns
RATE = 3e-3  # of Adam at first; it falls to nothing
STDS = (0.003, 0.1, 0.15)  # of the noise: the least, at first, the most
LOOKS = 8  # evaluations on the way


class ActorCritic(nn.Module):
    """Mean and standard deviation of the action `[D]`, and the value."""

    actions: int

    @nn.compact
    def __call__(self, x):
        def mlp(size, scale):
            h = x
            for width in (64, 64):
                h = nn.tanh(nn.Dense(width, kernel_init=nn.initializers.orthogonal(2**0.5))(h))
            return nn.Dense(size, kernel_init=nn.initializers.orthogonal(scale))(h)

        mean, wide = jnp.split(mlp(2 * self.actions, 0.01), 2, axis=-1)
        least, first, most = STDS
        std = least + (most - least) * nn.sigmoid(wide + jnp.log((first - least) / (most - first)))
        return mean, std, mlp(1, 1.0)[..., 0]


def where(which, a, b):
    return jax.tree.map(lambda x, y: jnp.where(which.reshape(-1, *[1] * (y.ndim - 1)), x, y), a, b)


def log_prob(mean, std, action):
    """Up to a constant."""
    return -jnp.sum(0.5 * ((action - mean) / std) ** 2 + jnp.log(std), axis=-1)


def make(env, envs, iterations, minibatches):
    """(first, iterate, evaluate) of a learner in so many environments."""
    network = ActorCritic(env.action_size)
    rate = optax.linear_schedule(RATE, 0.0, iterations * EPOCHS * minibatches)
    optimizer = optax.chain(optax.clip_by_global_norm(0.5), optax.adam(rate))
    reset, step = jax.vmap(env.reset), jax.vmap(env.step)

    @jax.jit
    def first(key):
        key_params, key_reset = jax.random.split(key)
        state = reset(jax.random.split(key_reset, envs))
        params = network.init(key_params, state.obs)
        return params, optimizer.init(params), state

    def rollout(params, state, key):
        """Acts. An episode that is over begins anew where its lane's key says, drawn once."""
        key_reset, key_act = jax.random.split(key)
        starts = reset(jax.random.split(key_reset, envs))

        def body(state, key):
            mean, std, value = network.apply(params, state.obs)
            action = mean + std * jax.random.normal(key, mean.shape)
            after = step(state, action)
            over = (after.done > 0) | (after.data.step >= EPISODE)
            seen = {
                "obs": state.obs,
                "action": action,
                "value": value,
                "log_prob": log_prob(mean, std, action),
                "std": std,
                "reward": (1 - GAMMA) * after.reward,  # so that values are of order one
                "next": (1 - after.done) * network.apply(params, after.obs)[2],
                "over": over,
            }
            return where(over, starts, after), seen

        return jax.lax.scan(body, state, jax.random.split(key_act, LENGTH))

    def advantages(seen):
        def body(later, at):
            now = at["reward"] + GAMMA * at["next"] - at["value"]
            now = now + GAMMA * LAMBDA * (1 - at["over"]) * later
            return now, now

        return jax.lax.scan(body, jnp.zeros(envs), seen, reverse=True)[1]

    def loss(params, batch):
        mean, std, value = network.apply(params, batch["obs"])
        ratio = jnp.exp(log_prob(mean, std, batch["action"]) - batch["log_prob"])
        gain = (batch["gain"] - batch["gain"].mean()) / (batch["gain"].std() + 1e-8)
        policy = jnp.minimum(ratio * gain, jnp.clip(ratio, 1 - CLIP, 1 + CLIP) * gain)
        return 0.5 * jnp.mean((value - batch["target"]) ** 2) - policy.mean()

    @partial(jax.jit, donate_argnums=(0, 1))
    def iterate(params, memory, state, key):
        key_act, key_shuffle = jax.random.split(key)
        state, seen = rollout(params, state, key_act)
        seen["gain"] = advantages(seen)
        seen["target"] = seen["gain"] + seen["value"]
        flat = jax.tree.map(lambda x: x.reshape(envs * LENGTH, *x.shape[2:]), seen)

        def update(learned, rows):
            params, memory = learned
            batch = jax.tree.map(lambda x: x[rows], flat)
            change, memory = optimizer.update(jax.grad(loss)(params, batch), memory)
            return (optax.apply_updates(params, change), memory), None

        keys = jax.random.split(key_shuffle, EPOCHS)
        rows = jnp.stack([jax.random.permutation(key, envs * LENGTH) for key in keys])
        rows = rows.reshape(EPOCHS * minibatches, -1)
        (params, memory), _ = jax.lax.scan(update, (params, memory), rows)
        said = {"reward": seen["reward"].mean() / (1 - GAMMA), "std": seen["std"].mean()}
        return params, memory, state, said

    @jax.jit
    def evaluate(params, key):
        """Share of strict successes with the mean action, and their mean time in s."""

        def going(state):
            return jnp.any((state.done == 0) & (state.data.step < env.episode_length))

        def act(state):
            return step(state, network.apply(params, state.obs)[0])

        state = jax.lax.while_loop(going, act, reset(jax.random.split(key, envs)))
        success = state.metrics["is_success"]
        mean_s = jnp.sum(success * state.data.step) * env.dt / jnp.maximum(success.sum(), 1)
        return {"success": success.mean(), "mean_s": mean_s}

    return first, iterate, evaluate


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--task", default="reach")
    parser.add_argument("--trocar", default="all")
    parser.add_argument("--action-space", default="rcm4")
    parser.add_argument("--envs", type=int, default=128)
    parser.add_argument("--iterations", type=int, default=160)
    parser.add_argument("--minibatches", type=int, default=8)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    runtime.prepare_xla()  # before the first jax array: physics on a CPU wants it
    from starjax.envs import playground

    env = playground.make(given.task, trocar=given.trocar, action_space=given.action_space)
    first, iterate, evaluate = make(env, given.envs, given.iterations, given.minibatches)
    key, key_evaluate = jax.random.split(jax.random.key(given.seed))
    params, memory, state = first(key)
    began, every = time.perf_counter(), max(1, given.iterations // LOOKS)
    for i in range(1, given.iterations + 1):
        params, memory, state, said = iterate(params, memory, state, jax.random.fold_in(key, i))
        if i % every == 0 or i == given.iterations:
            line = {"steps": i * given.envs * LENGTH, **said}
            line |= evaluate(params, jax.random.fold_in(key_evaluate, i))
            line["seconds"] = time.perf_counter() - began
            print(json.dumps({name: round(float(x), 4) for name, x in line.items()}), flush=True)


if __name__ == "__main__":
    main()
