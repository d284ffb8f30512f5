"""Runs the packaged policy in the simulation, for one trial at an unseen trocar.

The loop is that of a real robot; `starjax evaluate` runs whole batches as one program.
"""

import jax
import numpy as np

from starjax import deploy, rcm, runtime

MAX_S = 20.0  # simulated time


def main() -> None:
    runtime.prepare_xla()  # before the first jax array, or physics on a CPU is slow
    from starjax.sim import env

    policy = deploy.load("compact")
    settings = policy.settings
    made = env.make(image_size=settings.image_size)
    reset, step, observe = map(jax.jit, (made.reset, made.step, made.observe))

    trocar = rcm.Trocar(0.03, np.pi / 2, 0.4)
    arms = rcm.Trocar(*(np.full(1, field, np.float32) for field in trocar))  # `[A]`, one arm
    key_reset, key_policy = jax.random.split(jax.random.key(0))
    state = reset(key_reset, env.EnvParams(arms))
    history = [observe(state)] * settings.obs_horizon
    plans = 0
    while not state.done and state.step < MAX_S * made.control_hz:
        recent = jax.tree.map(lambda *x: np.stack(x), *history[-settings.obs_horizon :])
        one_arm = jax.tree.map(lambda x: x[:, 0], (recent.pose, recent.gripper))
        observation = deploy.Observation(*one_arm, image=recent.images["camera"])
        plan = policy(jax.random.fold_in(key_policy, plans), observation, trocar)
        for t in range(settings.execute):
            command = jax.tree.map(lambda x: x[t][None], plan)  # noqa: B023
            state = step(state, command)
            history.append(observe(state))
        plans += 1
    outcome = "success" if state.success else "no success"
    seconds = float(state.step) / made.control_hz
    print(f"{outcome} after {seconds:.1f} s, RCM error {1e3 * float(state.rcm_error[0]):.3f} mm")


if __name__ == "__main__":
    main()
