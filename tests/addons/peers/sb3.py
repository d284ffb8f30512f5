"""Learns reach with PPO or SAC of stable-baselines3, through `gymnasium.make_vec`.

    pip install 'starjax[gym]' stable-baselines3
    python tests/addons/peers/sb3.py > benchmarks/results/sb3_cpu.json

Prints the learning curve as JSON: every `--every` control steps the mean return, the strict
successes and the distance left of episodes with the mean action.
"""

import argparse
import json
import sys
import time
from importlib import metadata
from typing import Any

import gymnasium
import numpy as np

try:
    from stable_baselines3 import PPO, SAC
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.vec_env import VecEnv
except ImportError:
    sys.exit("skipped: stable-baselines3 is not installed")

from starjax.runtime import provenance

GAMMA = 0.9
# Noise begins small: see docs/use/reinforcement-learning.md. Steps and batches are those of
# examples/11_ppo.py.
LEARNERS = {
    "sac": (
        SAC,
        {"train_freq": 1, "gradient_steps": 4, "learning_starts": 2000, "learning_rate": 3e-4},
    ),
    "ppo": (
        PPO,
        {
            "n_steps": 32,
            "batch_size": 512,
            "n_epochs": 4,
            "learning_rate": 3e-3,
            "policy_kwargs": {"log_std_init": -2.3},
        },
    ),
}


class Lanes(VecEnv):
    """A vector environment of Gymnasium as stable-baselines3 wants it."""

    def __init__(self, env: gymnasium.vector.VectorEnv) -> None:
        self.env, self.render_mode = env, None
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> np.ndarray:
        return self.env.reset(seed=self._seeds[0])[0]

    def step_async(self, actions: np.ndarray) -> None:
        self.actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        seen, reward, terminated, truncated, info = self.env.step(self.actions)
        over = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in over]
        for i in np.flatnonzero(over):
            infos[i] = {
                "terminal_observation": info["final_obs"][i],
                "TimeLimit.truncated": bool(truncated[i]),
                "is_success": bool(info["final_info"]["is_success"][i]),
            }
        # scaled to values of order one
        return seen, (1 - GAMMA) * reward.astype(np.float32), over, infos

    def close(self) -> None:
        self.env.close()

    def get_attr(self, name: str, indices: Any = None) -> list[Any]:
        return [getattr(self.env, name)] * self.num_envs

    # Asked for by the base class; no learner here calls them.
    def set_attr(self, name: str, value: Any, indices: Any = None) -> None:
        raise NotImplementedError(name)

    def env_method(self, name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        raise NotImplementedError(name)

    def env_is_wrapped(self, wrapper: Any, indices: Any = None) -> list[bool]:
        return [False] * self.num_envs


class Curve(BaseCallback):
    """Evaluates now and then."""

    def __init__(self, env: gymnasium.vector.VectorEnv, every: int) -> None:
        super().__init__()
        self.env, self.every, self.points, self.began = env, every, [], time.perf_counter()

    def _on_step(self) -> bool:
        if self.num_timesteps >= self.every * len(self.points):
            self.measure()
        return True

    def measure(self) -> None:
        seconds = round(time.perf_counter() - self.began, 1)
        point = {"steps": self.num_timesteps, "seconds": seconds, **score(self.env, self.model)}
        self.points.append(point)
        print(json.dumps(point), file=sys.stderr, flush=True)


def score(env: gymnasium.vector.VectorEnv, model: Any) -> dict[str, float]:
    """One episode a lane, from the same starts every time."""
    seen, _ = env.reset(seed=1000)
    total, over = np.zeros(env.num_envs), np.zeros(env.num_envs, bool)
    while not over.all():
        actions, _ = model.predict(seen, deterministic=True)
        seen, reward, terminated, truncated, info = env.step(actions)
        total, over = total + reward, terminated | truncated
    return {"return": round(float(total.mean()), 2), "success": float(info["is_success"].mean())}


def decaying(settings: dict[str, Any]) -> dict[str, Any]:
    """With a learning rate that falls to nothing: with a constant one PPO forgets again."""
    return {**settings, "learning_rate": lambda left: left * settings["learning_rate"]}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--learner", choices=LEARNERS, default="ppo")
    parser.add_argument("--action-space", default="rcm4")
    parser.add_argument("--steps", type=int, default=800_000)
    parser.add_argument("--every", type=int, default=80_000)
    parser.add_argument("--lanes", type=int, default=128)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    task = {"trocar": "all", "action_space": given.action_space, "max_episode_steps": 150}
    env, judge = (
        gymnasium.make_vec(
            "starjax.envs:starjax/Reach-v0", given.lanes, autoreset_mode=mode, **task
        )
        for mode in ("SameStep", "Disabled")
    )
    make, settings = LEARNERS[given.learner]
    model = make(
        "MlpPolicy", Lanes(env), seed=given.seed, gamma=GAMMA, device="cpu", **decaying(settings)
    )
    curve = Curve(judge, given.every)
    model.learn(given.steps, callback=curve)
    curve.measure()
    packages = ("stable-baselines3", "torch", "gymnasium", "jax")
    made = {
        "peer": "stable-baselines3",
        "task": "reach",
        "arguments": vars(given),
        "settings": settings,
        "episode": task,
        "versions": {name: metadata.version(name) for name in packages},
        **provenance.code()._asdict(),
        "curve": curve.points,
    }
    print(json.dumps(made, indent=1))


if __name__ == "__main__":
    main()
