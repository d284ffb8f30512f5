"""A disturbance: the hand trembles, so commands are executed with an offset."""

import jax

from starjax.evaluation.disturbances.base import Disturbance


def on_step(env, disturbance, state, command):
    """Moves the commanded tip by a draw of this episode and step, then takes the step."""
    key = jax.random.fold_in(disturbance.key, state.step)
    noise = disturbance.level * 1e-3 * jax.random.normal(key, command.pose.p.shape)
    pose = command.pose._replace(p=command.pose.p + noise)
    return env.step(state, command._replace(pose=pose)), disturbance.memory


TREMOR = Disturbance(
    description="commands are off by a random distance",
    unit="mm",
    levels=(0.0, 0.2, 0.5),
    max_level=5.0,
    on_step=on_step,
)
