"""Splits a policy's failures: with the expert's jaws, or its tips on the last way to a grasp.

    python switches.py POLICY OUT [--trials 40] [--seed 977] [--seconds 40] [--execute N]

Success near the expert's with its jaws means that the policy moves well and misses the moment; with
its tips, that it closes in time and misses the place. The expert enters at every control step.
"""

import argparse
import importlib
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from starjax import runtime
from starjax.cli import policy_args, policy_evaluation
from starjax.core import config
from starjax.core.types import Command
from starjax.sim import registries
from starjax.sim.env import Env
from starjax.tasks import phases, scripting

LAST = 0.005  # m before a grasp
SWITCHES = ("none", "jaws", "tips")


def main() -> None:
    runtime.prepare_xla()
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("policy")
    parser.add_argument("out", type=Path)
    parser.add_argument("--trials", type=int, default=40, help="per trocar")
    parser.add_argument("--seed", type=int, default=977)
    parser.add_argument("--seconds", type=float, default=40.0)
    parser.add_argument("--execute", type=int, default=0, help="commands of a plan; 0: its own")
    parser.add_argument("--expert", default="", help="by default the task's first one")
    asked = parser.parse_args()
    path = policy_args.resolve(policy_args.PolicyArgs(policy=asked.policy))
    who, _ = policy_args.load(path._replace(execute=asked.execute))
    settings = config.EvalConfig(trials=asked.trials, time_limit_s=asked.seconds, video_trials=0)
    rows = {}
    for switch in SWITCHES:
        mixed = who._replace(env=switched(who.env, switch, asked.expert))
        trials = policy_evaluation.rollouts(
            asked.out / switch, mixed, who.env.task.trocars, settings, asked.seed
        )
        seen = who.env.task.is_seen[trials.trocar]
        rows[switch] = {
            name: [int(trials.success[part].sum()), int(part.sum())]
            for name, part in (("seen", seen), ("unseen", ~seen))
        }
        stages = zip(who.env.task.stages, jnp.bincount(trials.stage, length=9).tolist())
        print(switch, rows[switch], dict(stages), flush=True)
    (asked.out / "switches.json").write_text(json.dumps(rows, indent=1) + "\n")


def switched(env: Env, switch: str, expert: str) -> Env:
    """The environment that executes the expert's jaws, or its tips next to a grasp."""
    rescuer = registries.rescuers.get(registries.rescuer_name(env.task, expert))

    def step(state: Any, command: Command) -> Any:
        key = jax.random.fold_in(jax.random.key(0), state.step)
        memory = rescuer.resume(key, state)
        theirs = rescuer.act(memory, state)[2]
        if switch == "jaws":
            return env.step(state, command._replace(gripper=theirs.gripper))
        goal = memory.goal.reshape(-1, memory.goal.shape[-1])[:, -3:]
        is_near = jnp.linalg.norm(goal - state.pose.p, axis=-1) < LAST
        is_near &= goes_in(memory, env) & (command.gripper > scripting.SHUT)
        chosen = jax.tree.map(
            lambda a, b: jnp.where(is_near.reshape(-1, *[1] * (a.ndim - 1)), a, b),
            (theirs.pose, theirs.wrist),
            (command.pose, command.wrist),
        )
        return env.step(state, Command(chosen[0], command.gripper, chosen[1]))

    return env if switch == "none" else env._replace(step=step)


def goes_in(memory: Any, env: Env) -> jax.Array:
    """True `[A]` for tools on their way in to a grasp."""
    if env.task.arms == 1:
        return (memory.phase == phases.DESCEND)[None]
    play = importlib.import_module(f"starjax.tasks.{env.task.name}.expert").PLAY
    return jnp.asarray(play.looks)[memory.phase]


if __name__ == "__main__":
    main()
