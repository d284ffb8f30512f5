"""Where Proposition 1 holds: the share of the expert's wanted tip position that the trocar decides.

    python experiments/methods/proposition.py --task needle_pick [--scenes 16] [--seed 2026] [--c]

The proposition says that the wanted position does not depend on the trocar. So each of some scenes
is played at every trocar of the task, with the same objects, the same choices of the expert and the
same disturbance: differences between the trocars of a scene are caused by the trocar. Positions
are the undisturbed ones that demonstrations record. They are compared at the same progress within
the same phase of the expert's first attempt: progress is the share of the phase's own duration, as
paths through other trocars may take longer, and s in a phase without an end.

With y the position at scene s, trocar c and progress g, of one arm and phase,

    trocar = mean over s, c, g of |y - mean_c y|^2      scene = mean over g of var_s (mean_c y)
    share  = trocar / (trocar + scene)

and with the share, which a phase with nearly one place for all scenes makes large, the root of
`trocar` in mm: how far a trocar moves the wanted tip. `common` is the part of it that is the same
in all scenes. A task's own figures average the variances over its phases, weighted by their time.
Two arms are evaluated one by one; their trocars change together. Intervals draw scenes anew.

With a wrist two more points of each tool are compared: its yaw axis, which shows the direction of
the jaws, and its pitch axis, the end of the shaft.

A scene is its start. A policy also observes an object in its jaws, so the share bounds from above
the loss of a policy without the trocar as an input.
"""

import argparse
import importlib
import pathlib
import sys
from collections.abc import Callable
from typing import Any

sys.path.append(str(pathlib.Path(__file__).parents[2] / "benchmarks"))
import _c_env
import _decomposition
import _scene
import _timing
import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm, runtime
from starjax.core.types import Agent, Command
from starjax.sim import env as envs
from starjax.sim import wrists
from starjax.sim.task import Task

# Names of the phases of scripts that only number them, in order.
PHASES = {
    "peg_transfer": "raise approach descend close lift carry lower open retreat wait",
    "needle_pick": "raise approach descend close lift hold",
    "needle_regrasp": "raise approach descend close lift hold",
    "needle_drive": "raise approach descend drive hold",
    "needle_drive_dial": "raise approach descend drive hold",
    "ring_on_wire": "raise approach descend close lift carry lower open leave wait",
    "reach": "move rest",
    "endoscope_track": "find follow",
}


def main() -> None:
    runtime.prepare_xla()
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=16)
    parser.add_argument("--seed", type=int, default=2026)
    parser.add_argument("--c", action="store_true", help="C MuJoCo's physics instead of ours")
    _scene.add_flags(parser)
    arguments = parser.parse_args()
    environment = _scene.make(arguments, observation="state")
    if arguments.c:
        environment = _c_env.with_c_physics(environment)
    task = environment.task
    agent = task.expert()
    trials, successes = play(environment, agent, arguments.scenes, arguments.seed)
    found = {
        "scene": environment.names._asdict(),
        "seed": arguments.seed,
        "scenes": arguments.scenes,
        "trocars": len(trials[0]),
        "episodes": sum(map(len, trials)),
        "successes": successes,
        **decomposed(trials, names(task.name), points(task)),
    }
    for name, arm in found["arms"].items():
        print(f"{task.name}, {name}: {summary(arm)}")
        for phase, row in arm["phases"].items():
            print(f"  {phase:9} {summary(row)}, {row['scenes']} scenes")
    name = "proposition_c" if arguments.c else "proposition"
    print("written to", _timing.write(name, {"results": {task.name: found}}))


def names(task: str) -> list[str]:
    """Names of the expert's phases."""
    if task in PHASES:
        return PHASES[task].split()
    return list(importlib.import_module(f"starjax.tasks.{task}.expert").PHASES)


def points(task: Task) -> list[str]:
    """Names of the compared points, in the order of `wanted`."""
    held = wrists.per_arm(task)
    found = [f"arm{arm}" for arm in range(task.arms)]
    bent = [arm for arm, wrist in enumerate(held) if wrist is not None]
    return found + [f"arm{arm} {axis} axis" for arm in bent for axis in ("yaw", "pitch")]


def wanted(task: Task, label: Command) -> jax.Array:
    """Positions `[K, 3]` m of a command: the tips, and the axes of the wrists."""
    found = [label.pose.p]
    for arm, wrist in enumerate(wrists.per_arm(task)):
        if wrist is not None:
            assert label.wrist is not None
            tip = jax.tree.map(lambda x, arm=arm: x[arm], label.pose)
            yaw = tip.p - wrist.jaws * tip.R[:, 2]
            found += [yaw[None], rcm.shaft_of(wrist, tip, label.wrist[arm]).p[None]]
    return jnp.concatenate(found)


def play(
    environment: envs.Env, agent: Agent, scenes: int, seed: int
) -> tuple[list[list[list[_decomposition.Segment]]], int]:
    """Segments `[S][C]` of all trials, and how many of them succeed."""
    listed = environment.task.trocars
    steps = max(600, environment.task.least_steps)
    run = jax.jit(jax.vmap(_episode(environment, agent, steps), in_axes=(0, None)))
    keys = jax.random.split(jax.random.key(seed), scenes)
    trials: list[list[list[_decomposition.Segment]]] = [[] for _ in range(scenes)]
    successes = 0
    for c in range(len(listed.radius)):
        trocar = rcm.Trocar(*(jnp.asarray(field[c]) for field in listed))
        live, success, *series = jax.device_get(run(keys, trocar))
        successes += int(success.sum())
        for s, length in enumerate(live.sum(1)):
            trials[s].append(_decomposition.first_attempt(*(x[s, :length] for x in series)))
    return trials, successes


def _episode(environment: envs.Env, agent: Agent, steps: int) -> Callable[..., Any]:
    """(key, trocar) -> True while it ran `[T]`, success, and the inputs of `first_attempt`."""

    def run(key: jax.Array, trocar: rcm.Trocar) -> tuple[jax.Array, ...]:
        key_reset, key_expert = jax.random.split(key)
        state = environment.reset(key_reset, envs.EnvParams(trocar))
        carry = (state, agent.init(key_expert, state))
        task = environment.task
        shapes = _shapes(task, agent, carry)
        blank = jax.tree.map(lambda s: jnp.zeros((steps, *s.shape), s.dtype), shapes)

        def step(loop):
            (state, memory), rows = loop
            command, memory, label = agent.act(memory, state)
            row = (jnp.ones((), bool), *where(memory), wanted(task, label))
            rows = jax.tree.map(lambda all_, one: all_.at[state.step].set(one), rows, row)
            return (environment.step(state, command), memory), rows

        def is_on(loop):
            return ~loop[0][0].done & (loop[0][0].step < steps)

        (state, _), rows = jax.lax.while_loop(is_on, step, (carry, blank))
        return rows[0], state.success, *rows[1:]

    return run


def _shapes(task: Task, agent: Agent, carry: Any) -> Any:
    def row(state, memory):
        _, memory, label = agent.act(memory, state)
        return (jnp.ones((), bool), *where(memory), wanted(task, label))

    return jax.eval_shape(row, *carry)


def where(memory: Any) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Phase, s in it, and progress of a script.

    One without phases is on its way for its duration, and at its goal afterwards.
    """
    if hasattr(memory, "phase"):
        progress = jnp.minimum(memory.elapsed / memory.duration, 1.0)
        return memory.phase, memory.elapsed, progress
    after = memory.elapsed - memory.duration
    is_there = after > 0
    progress = jnp.where(is_there, after, memory.elapsed / memory.duration)
    return is_there.astype(jnp.int32), memory.elapsed, progress


def decomposed(
    trials: list[list[list[_decomposition.Segment]]], phases: list[str], points: list[str]
) -> dict[str, Any]:
    """`arms`: name of a point -> figures of the task and of its `phases`."""
    crossed = _decomposition.crossed(trials)
    spent = {
        phase: np.mean([sum(len(s.p) for s in x if s.phase == phase) for y in trials for x in y])
        for phase in crossed
    }
    found: dict[str, Any] = {}
    for arm, point in enumerate(points):
        rows: dict[str, Any] = {}
        every: list[np.ndarray] = []
        weights: list[float] = []
        for phase, visits in crossed.items():
            mine = [visit[:, :, :, arm] for visit in visits]
            even = [1.0] * len(mine)
            name = phases[phase] if phase < len(phases) else str(phase)
            rows[name] = _figures(mine, even) | {"scenes": max(map(len, mine))}
            every += mine
            weights += [float(spent[phase]) / len(mine)] * len(mine)
        most = max(rows, key=lambda name: rows[name]["trocar_mm"])
        found[point] = {
            **_figures(every, weights),
            "most": {"phase": most, **rows[most]},
            "phases": rows,
        }
    return {"arms": found}


def _figures(p: list[np.ndarray], weights: list[float]) -> dict[str, Any]:
    parts = _decomposition.together([_decomposition.parts(x) for x in p], weights)
    rms = {name: 1e3 * value**0.5 for name, value in parts._asdict().items()}
    low, high = _decomposition.interval(p, weights)
    return {"share": parts.share, "low": low, "high": high} | {
        f"{name}_mm": value for name, value in rms.items()
    }


def summary(row: dict[str, Any]) -> str:
    """A row in words."""
    share = f"{100 * row['share']:.1f}% ({100 * row['low']:.1f}-{100 * row['high']:.1f})"
    return f"{share}; the trocar moves it {row['trocar_mm']:.2f} mm, scenes {row['scene_mm']:.2f}"


if __name__ == "__main__":
    main()
