"""Learns a task by proximal policy optimisation; an iteration is one compiled program.

    python examples/11_ppo.py                                               # a CPU
    python examples/11_ppo.py --envs 4096 --iterations 60 --minibatches 32   # a GPU

Needs optax, flax, jax and mujoco-mjx. Prints the learning curve as one JSON object per line, with
the success rate of the mean action.

The noise is small, and the network predicts its size. The controller bounds acceleration: large
noise saturates that bound for any mean action, and a policy that jumps across the goal then loses
nothing and does not learn to rest there.
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
EPISODE = 150  # maximum control steps of a training episode
RATE = 3e-3  # initial learning rate of Adam, decays to zero
STDS = (0.003, 0.1, 0.15)  # of the noise: minimum, initial, maximum
EVALUATIONS = 8  # during training


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
        low, first, high = STDS
        std = low + (high - low) * nn.sigmoid(wide + jnp.log((first - low) / (high - first)))
        return mean, std, mlp(1, 1.0)[..., 0]


def where(which, a, b):
    return jax.tree.map(lambda x, y: jnp.where(which.reshape(-1, *[1] * (y.ndim - 1)), x, y), a, b)


def log_prob(mean, std, action):
    """Returns the log probability up to a constant."""
    return -jnp.sum(0.5 * ((action - mean) / std) ** 2 + jnp.log(std), axis=-1)


def make(env, envs, iterations, minibatches):
    """Returns the functions (first, iterate, evaluate) of a learner in `envs` environments."""
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
        """Acts for LENGTH steps; a finished episode restarts at its lane's one drawn start."""
        key_reset, key_act = jax.random.split(key)
        starts = reset(jax.random.split(key_reset, envs))

        def body(state, key):
            mean, std, value = network.apply(params, state.obs)
            action = mean + std * jax.random.normal(key, mean.shape)
            after = step(state, action)
            over = (after.done > 0) | (after.data.step >= EPISODE)
            transition = {
                "obs": state.obs,
                "action": action,
                "value": value,
                "log_prob": log_prob(mean, std, action),
                "std": std,
                "reward": (1 - GAMMA) * after.reward,  # keeps values of order one
                "next": (1 - after.done) * network.apply(params, after.obs)[2],
                "over": over,
            }
            return where(over, starts, after), transition

        return jax.lax.scan(body, state, jax.random.split(key_act, LENGTH))

    def advantages(transitions):
        def body(later, at):
            now = at["reward"] + GAMMA * at["next"] - at["value"]
            now = now + GAMMA * LAMBDA * (1 - at["over"]) * later
            return now, now

        return jax.lax.scan(body, jnp.zeros(envs), transitions, reverse=True)[1]

    def loss(params, batch):
        mean, std, value = network.apply(params, batch["obs"])
        ratio = jnp.exp(log_prob(mean, std, batch["action"]) - batch["log_prob"])
        gain = (batch["gain"] - batch["gain"].mean()) / (batch["gain"].std() + 1e-8)
        policy = jnp.minimum(ratio * gain, jnp.clip(ratio, 1 - CLIP, 1 + CLIP) * gain)
        return 0.5 * jnp.mean((value - batch["target"]) ** 2) - policy.mean()

    @partial(jax.jit, donate_argnums=(0, 1))
    def iterate(params, memory, state, key):
        key_act, key_shuffle = jax.random.split(key)
        state, batch = rollout(params, state, key_act)
        batch["gain"] = advantages(batch)
        batch["target"] = batch["gain"] + batch["value"]
        flat = jax.tree.map(lambda x: x.reshape(envs * LENGTH, *x.shape[2:]), batch)

        def update(learned, rows):
            params, memory = learned
            grads = jax.grad(loss)(params, jax.tree.map(lambda x: x[rows], flat))
            change, memory = optimizer.update(grads, memory)
            return (optax.apply_updates(params, change), memory), None

        keys = jax.random.split(key_shuffle, EPOCHS)
        rows = jnp.stack([jax.random.permutation(key, envs * LENGTH) for key in keys])
        rows = rows.reshape(EPOCHS * minibatches, -1)
        (params, memory), _ = jax.lax.scan(update, (params, memory), rows)
        metrics = {"reward": batch["reward"].mean() / (1 - GAMMA), "std": batch["std"].mean()}
        return params, memory, state, metrics

    @jax.jit
    def evaluate(params, key):
        """Returns the strict success rate of the mean action and the mean time in s."""

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
    args = parser.parse_args()
    runtime.prepare_xla()  # before the first jax array, or physics on a CPU is slow
    from starjax.addons.playground import environment as playground

    env = playground.make(args.task, trocar=args.trocar, action_space=args.action_space)
    first, iterate, evaluate = make(env, args.envs, args.iterations, args.minibatches)
    key, key_evaluate = jax.random.split(jax.random.key(args.seed))
    params, memory, state = first(key)
    began, every = time.perf_counter(), max(1, args.iterations // EVALUATIONS)
    for i in range(1, args.iterations + 1):
        params, memory, state, metrics = iterate(params, memory, state, jax.random.fold_in(key, i))
        if i % every == 0 or i == args.iterations:
            line = {"steps": i * args.envs * LENGTH, **metrics}
            line |= evaluate(params, jax.random.fold_in(key_evaluate, i))
            line["seconds"] = time.perf_counter() - began
            print(json.dumps({name: round(float(x), 4) for name, x in line.items()}), flush=True)


if __name__ == "__main__":
    main()
