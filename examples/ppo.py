"""Learns a task by proximal policy optimisation; an iteration is one compiled program.

    python examples/ppo.py --envs 4096 --iterations 100      # a GPU
    python examples/ppo.py                                   # a CPU

Needs optax and flax beside jax and mujoco-mjx. Prints one JSON object a line: the curve, and at
last how often the mean action succeeds. Noise is drawn with memory, as tools are moved, not shaken,
and shrinks, as success is to rest.
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
EPOCHS, MINIBATCHES = 4, 8
LENGTH = 32  # control steps of an iteration
EPISODE = 150  # control steps at most while it learns
RATE = 1.5e-3  # at the first iteration; it shrinks with the noise
STD = (0.6, 0.005)  # of the noise, in the first half of the iterations and at the last one
MEMORY = 0.9  # correlation of the noise from one control step to the next


class ActorCritic(nn.Module):
    """Mean of the action `[D]`, and the value."""

    actions: int

    @nn.compact
    def __call__(self, x):
        def mlp(size, scale):
            h = x
            for width in (64, 64):
                h = nn.tanh(nn.Dense(width, kernel_init=nn.initializers.orthogonal(2**0.5))(h))
            return nn.Dense(size, kernel_init=nn.initializers.orthogonal(scale))(h)

        return mlp(self.actions, 0.01), mlp(1, 1.0)[..., 0]


def where(which, a, b):
    return jax.tree.map(lambda x, y: jnp.where(which.reshape(-1, *[1] * (y.ndim - 1)), x, y), a, b)


def make(env, envs):
    """(first, iterate, evaluate) of a learner in so many environments."""
    network = ActorCritic(env.action_size)
    optimizer = optax.chain(optax.clip_by_global_norm(0.5), optax.scale_by_adam())
    reset, step = jax.vmap(env.reset), jax.vmap(env.step)

    @jax.jit
    def first(key):
        key_params, key_reset = jax.random.split(key)
        state = reset(jax.random.split(key_reset, envs))
        params = network.init(key_params, state.obs)
        noise = jnp.zeros((envs, env.action_size))
        return params, optimizer.init(params), (state, noise)

    def log_prob(mean, seen, std):
        """Of an action, given the noise before it, up to a constant."""
        fresh = (seen["action"] - mean - MEMORY * seen["noise"]) / (std * (1 - MEMORY**2) ** 0.5)
        return -0.5 * jnp.sum(fresh**2, axis=-1)

    def rollout(params, carry, std, key):
        """Acts. An episode that is over begins anew where its lane's key says, drawn once."""
        key_reset, key_act = jax.random.split(key)
        starts = reset(jax.random.split(key_reset, envs))

        def body(carry, key):
            state, noise = carry
            mean, value = network.apply(params, state.obs)
            fresh = std * (1 - MEMORY**2) ** 0.5 * jax.random.normal(key, mean.shape)
            action = mean + MEMORY * noise + fresh
            after = step(state, action)
            over = (after.done > 0) | (after.data.step >= EPISODE)
            _, after_value = network.apply(params, after.obs)
            seen = {"obs": state.obs, "action": action, "noise": noise, "value": value}
            seen |= {
                "log_prob": log_prob(mean, seen, std),
                "reward": (1 - GAMMA) * after.reward,  # so that values are of order one
                "next": (1 - after.done) * after_value,
                "over": over,
                "success": after.metrics["is_success"],
            }
            noise = where(over, jnp.zeros_like(noise), action - mean)
            return (where(over, starts, after), noise), seen

        return jax.lax.scan(body, carry, jax.random.split(key_act, LENGTH))

    def advantages(seen):
        def body(later, at):
            now = at["reward"] + GAMMA * at["next"] - at["value"]
            now = now + GAMMA * LAMBDA * (1 - at["over"]) * later
            return now, now

        return jax.lax.scan(body, jnp.zeros(envs), seen, reverse=True)[1]

    def loss(params, batch, std):
        mean, value = network.apply(params, batch["obs"])
        ratio = jnp.exp(log_prob(mean, batch, std) - batch["log_prob"])
        gain = (batch["gain"] - batch["gain"].mean()) / (batch["gain"].std() + 1e-8)
        policy = jnp.minimum(ratio * gain, jnp.clip(ratio, 1 - CLIP, 1 + CLIP) * gain)
        return 0.5 * jnp.mean((value - batch["target"]) ** 2) - policy.mean()

    @partial(jax.jit, donate_argnums=(0, 1))
    def iterate(params, memory, carry, std, key):
        key_act, key_shuffle = jax.random.split(key)
        carry, seen = rollout(params, carry, std, key_act)
        seen["gain"] = advantages(seen)
        seen["target"] = seen["gain"] + seen["value"]
        flat = jax.tree.map(lambda x: x.reshape(envs * LENGTH, *x.shape[2:]), seen)

        def update(learned, rows):
            params, memory = learned
            batch = jax.tree.map(lambda x: x[rows], flat)
            change, memory = optimizer.update(jax.grad(loss)(params, batch, std), memory)
            change = jax.tree.map(lambda x: -RATE * std / STD[0] * x, change)
            return (optax.apply_updates(params, change), memory), None

        keys = jax.random.split(key_shuffle, EPOCHS)
        rows = jnp.stack([jax.random.permutation(key, envs * LENGTH) for key in keys])
        rows = rows.reshape(EPOCHS * MINIBATCHES, -1)
        (params, memory), _ = jax.lax.scan(update, (params, memory), rows)
        reward = seen["reward"].mean() / (1 - GAMMA)
        return params, memory, carry, {"reward": reward, "successes": seen["success"].sum()}

    @jax.jit
    def evaluate(params, key):
        """Share of strict successes with the mean action, and their mean time in s."""

        def going(state):
            return jnp.any((state.done == 0) & (state.data.step < env.episode_length))

        def act(state):
            return step(state, network.apply(params, state.obs)[0])

        state = jax.lax.while_loop(going, act, reset(jax.random.split(key, envs)))
        success = state.metrics["is_success"]
        seconds = jnp.sum(success * state.data.step) * env.dt
        return success.mean(), seconds / jnp.maximum(success.sum(), 1)

    return first, iterate, evaluate


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--task", default="reach")
    parser.add_argument("--trocar", default="all")
    parser.add_argument("--action-space", default="rcm4")
    parser.add_argument("--envs", type=int, default=64)
    parser.add_argument("--iterations", type=int, default=240)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    runtime.prepare_xla()  # before the first jax array: physics on a CPU wants it
    from starjax.envs import playground

    env = playground.make(given.task, trocar=given.trocar, action_space=given.action_space)
    first, iterate, evaluate = make(env, given.envs)
    key = jax.random.key(given.seed)
    params, memory, carry = first(key)
    began = time.perf_counter()
    for i in range(given.iterations):
        std = STD[0] * (STD[1] / STD[0]) ** max(0.0, 2 * i / given.iterations - 1)
        params, memory, carry, said = iterate(
            params, memory, carry, jnp.float32(std), jax.random.fold_in(key, i)
        )
        if i % 10 == 9 or i + 1 == given.iterations:
            line = {"steps": (i + 1) * given.envs * LENGTH, "std": std, **said}
            line["seconds"] = time.perf_counter() - began
            print(json.dumps({name: round(float(x), 4) for name, x in line.items()}), flush=True)
    success, mean_s = evaluate(params, jax.random.fold_in(key, given.iterations))
    print(json.dumps({"episodes": given.envs, "success": float(success), "mean_s": float(mean_s)}))


if __name__ == "__main__":
    main()
