"""Closed-loop evaluation: 12 trocars x 30 trials of up to 60 s.

    python benchmarks/bench_evaluate.py [--image 256] [--policy FILE] [--trials 30] [--tiny]

Without `--policy` an untrained policy is run: nothing ends early, so this is the worst case. With
one, a trial ends when the block stands on its peg, and its comparison ends there too. The
programs are those of `starjax evaluate`, on as many trials at once, a CPU's cores side by side;
compiling them is timed apart, by a trial that is over before it begins. Compared with C MuJoCo on
one thread would need for the physics steps alone, and, as the floor, the sum of the parts timed one
by one in this process (on a CPU each has all cores, so less is possible).
"""

import argparse
import math
import pathlib
import time
from collections.abc import Generator

import _c_mujoco
import _peer
import _setup
import _timing
import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm, runtime
from starjax.core.types import Command
from starjax.evaluation import evaluate, latency
from starjax.policies import features, in_env, packaged
from starjax.sim import env as envs
from starjax.sim.rollouts import agent, engine, episodes, workers


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    side = 256 if _peer.platform() == "gpu" else 0
    parser.add_argument("--image", type=int, default=side, help="side in pixels; 0: task state")
    parser.add_argument("--policy", help="a policy.safetensors, or the name of a packaged one")
    parser.add_argument("--trials", type=int, default=30, help="a trocar")
    parser.add_argument("--limit", type=float, default=60.0, help="s, of a trial")
    parser.add_argument("--lanes", type=int, default=0, help="trials at once; 0: the product's")
    parser.add_argument("--tiny", action="store_true", help="a test's sizes, nothing is written")
    asked = parser.parse_args()
    runtime.prepare_xla()
    if asked.tiny:
        asked.trials, asked.limit, asked.lanes = 1, 0.5, 4
    env, policy, params, stats, settings = subject(asked)
    subject_name = pathlib.Path(asked.policy).stem if asked.policy else "untrained"
    steps = math.ceil(asked.limit * env.control_hz)
    trials = listed(env, asked.trials)
    lanes = asked.lanes or evaluate.lanes_per_device(jax.devices()[0], len(trials))
    run = runner(env, policy, settings, steps, lanes)
    chunks = [trials[first : first + lanes] for first in range(0, len(trials), lanes)]

    def simulate(group: list[episodes.Trial]) -> Generator[np.ndarray]:
        found = []
        for segment in run((params, stats), group):
            found += [episode.outcome["length"] for episode in segment.ended]
            yield np.array(found if segment.passed == 1.0 else [], int)

    compile_s = _timing.time_once(lambda: list(run((params, stats), over_at_once(env))))
    start = time.perf_counter()
    lengths = [
        found for found in workers.run(chunks, simulate, workers.worker_count()) if len(found)
    ]
    run_s = time.perf_counter() - start

    control_steps = int(sum(found.sum() for found in lengths))
    substeps = round(1 / env.control_hz / env.scene.mj_model.opt.timestep)
    c_s = control_steps * substeps / _c_mujoco.steps_per_s(env.scene)
    plans = sum(math.ceil(found.max() / settings.execute) for found in lengths)
    found = parts(env, policy, params, stats, settings, lanes)
    floor = (
        1e-3
        * plans
        * (
            found["policy_ms"]
            + settings.execute * found["step_ms"]
            + settings.obs_horizon * found["observe_ms"]
        )
    )
    row = {
        "policy": subject_name,
        "trials": sum(map(len, lengths)),
        "time_limit_s": asked.limit,
        "lanes": lanes,
        "chunks": len(chunks),
        "control_steps": control_steps,
        "run_s": run_s,
        "compile_s": compile_s,
        "simulated_s_a_second": control_steps / env.control_hz / run_s,
        "c_physics_alone_s": c_s,
        "times_c_physics_speed": c_s / run_s,
        "sum_of_parts_s": floor,
        "ratio_to_sum_of_parts": run_s / floor,
        **found,
    }
    name = f"image {settings.image_size} px" if settings.observation == "image" else "state"
    name += f", {subject_name}"
    print(
        f"{name}: {row['trials']} trials of {asked.limit:g} s at most in {run_s:.2f} s, compiling "
        f"{compile_s:.1f} s; C MuJoCo's physics alone {c_s:.1f} s; {lanes} trials at once; "
        f"parts {floor:.2f} s (policy {found['policy_ms']:.2f}, step {found['step_ms']:.2f}, "
        f"observe {found['observe_ms']:.2f} ms)"
    )
    _timing.report("evaluate", {"results": {name: row}}, asked.tiny)


def subject(asked: argparse.Namespace):
    """Environment, policy, parameters, statistics and settings: of a trained policy, or of a new
    one of the right size."""
    if asked.policy:
        file = packaged.find("--policy", asked.policy)
        who = in_env.place_in_own_scene(file, in_env.read(file))
        trained = jax.device_put((who.trained.params, who.trained.normalizer))
        return who.env, who.policy, *trained, who.trained.policy
    case = _setup.paper(224) if _peer.platform() == "gpu" else _setup.small(1, asked.image)
    case = _setup.looking(_setup.miniature() if asked.tiny else case, asked.image)
    seen = {"image_size": case.policy.image_size, "observation": case.policy.observation}
    return envs.make(**seen), *_setup.untrained(case), case.policy


def listed(env: envs.Env, trials: int) -> list[episodes.Trial]:
    """All trials of the task's configurations of trocars."""
    return [(i, trial) for i in range(len(env.task.is_seen)) for trial in range(trials)]


def over_at_once(env: envs.Env) -> list[episodes.Trial]:
    """A trial of `runner` that is over before it begins."""
    return [(len(env.task.is_seen), 0)]


def runner(env, policy, settings, max_steps: int, lanes: int, devices=None) -> engine.Run:
    """The programs of an evaluation.

    One more configuration of trocars has no place, see `over_at_once`.
    """
    nowhere = np.full((1, env.task.arms), np.nan, np.float32)
    trocars = rcm.Trocar(*(np.concatenate([field, nowhere]) for field in env.task.trocars))
    planner = agent.from_policy(policy.sample, settings.obs_horizon, settings.execute)
    rules = engine.RolloutSettings(0, None, max_steps, lanes)
    return engine.make(env, planner, trocars, rules, episodes.SCORE, devices)


def parts(env, policy, params, stats, settings, lanes: int) -> dict[str, float]:
    """ms: one policy call, one control step and one look, each of all lanes."""
    observation, trocar = latency.example(
        settings, features.select_sensors(env.task, env.names.cameras), lanes
    )
    told = rcm.trocar_frame(trocar, env.p_world_ref, env.scene.roll_zero)
    keys = jax.random.split(jax.random.key(0), lanes)
    state = jax.jit(jax.vmap(env.reset))(keys, envs.EnvParams(trocar))
    command = Command(state.pose, jnp.ones_like(state.gripper))

    def some_steps(state, command):
        step = jax.vmap(env.step)
        return jax.lax.fori_loop(0, settings.execute, lambda _, s: step(s, command), state)

    step, state = _timing.time_carried(some_steps, state, command, repeats=3)
    call = _timing.time_jitted(policy.sample, params, stats, keys, observation, told, repeats=3)
    look = _timing.time_jitted(jax.vmap(env.observe), state, repeats=3)
    return {
        "policy_ms": 1e3 * call.median_s,
        "step_ms": 1e3 * step.median_s / settings.execute,
        "observe_ms": 1e3 * look.median_s,
    }


if __name__ == "__main__":
    main()
