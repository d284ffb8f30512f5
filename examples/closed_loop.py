"""Runs the packaged policy in the simulation, one trial at a trocar that it never saw.

The policy is driven as in a robot's loop; `starjax evaluate` runs whole batches as one program.
"""

import jax
import numpy as np

from starjax import deploy, rcm, runtime

MOST_S = 20.0  # of simulated time


def main() -> None:
    runtime.prepare_xla()  # before the first jax array: physics on a CPU wants it
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
    decision = 0
    while not state.done and state.step < MOST_S * made.control_hz:
        seen = jax.tree.map(lambda *x: np.stack(x), *history[-settings.obs_horizon :])
        one_arm = jax.tree.map(lambda x: x[:, 0], (seen.pose, seen.gripper))
        observation = deploy.Observation(*one_arm, image=seen.images["camera"])
        plan = policy(jax.random.fold_in(key_policy, decision), observation, trocar)
        for t in range(settings.execute):
            command = jax.tree.map(lambda x: x[t][None], plan)  # noqa: B023
            state = step(state, command)
            history.append(observe(state))
        decision += 1
    outcome = "success" if state.success else "no success"
    seconds = float(state.step) / made.control_hz
    print(f"{outcome} after {seconds:.1f} s, RCM error {1e3 * float(state.rcm_error[0]):.3f} mm")


if __name__ == "__main__":
    main()
