"""Scripted expert of endoscope tracking: to the target along an arc, then with it.

Centring, distance and level determine the scope's pose in closed form. It aims at the target's
position at the end of the control step. Side of the arc and pace are drawn, never by the trocar. It
is disturbed on purpose and corrects itself. Executed commands are too near or too far throughout an
episode, so a policy learns to correct that.
"""

import flax.struct
import jax
import jax.numpy as jnp

from starjax import rcm
from starjax.core.types import Agent, Command
from starjax.sim.state import EnvState
from starjax.sim.task import CONTROL_HZ
from starjax.tasks import scripting
from starjax.tasks.endoscope_track.task import DISTANCE, looking_at

FIND_TIME = (1.0, 1.6)  # s, range of the way to the target
DISTURBED_DISTANCE = (0.9, 1.1)  # parts of DISTANCE, range of an episode's executed distance
BULGE = 0.008  # m, the arc's largest offset from the line
DEVIATION = (0.0008, 0.0008, 0.0008, 0.012)  # m and rad, of the disturbance
DISTURBANCE = 0.7  # its weight once the target is reached


@flax.struct.dataclass
class TrackScript:
    """Script of one episode.

    Attributes:
      key: of all draws.
      start: `[4]` roll (rad) and position (m).
      side: `[3]` m, the arc's largest offset from the line.
      distance: m, executed instead of DISTANCE.
      duration, elapsed: s.
      noise: `[2, 4]`, disturbance of position and roll, rough and smooth.
    """

    key: jax.Array
    start: jax.Array
    side: jax.Array
    distance: jax.Array
    duration: jax.Array
    elapsed: jax.Array
    noise: jax.Array


def init(key: jax.Array, state: EnvState) -> TrackScript:
    """Draws side, pace and disturbed distance."""
    key, key_side, key_time, key_distance = jax.random.split(key, 4)
    sign = jax.random.rademacher(key_side, (), jnp.float32)
    return TrackScript(
        key=key,
        start=jnp.append(0.0, state.pose.p[0]),
        side=sign * BULGE * jnp.array([0.0, 1.0, 0.0]),
        distance=DISTANCE * jax.random.uniform(key_distance, (), jnp.float32, *DISTURBED_DISTANCE),
        duration=jax.random.uniform(key_time, minval=FIND_TIME[0], maxval=FIND_TIME[1]),
        elapsed=jnp.zeros(()),
        noise=jnp.zeros((2, 4)),
    )


def act(script: TrackScript, state: EnvState) -> tuple[Command, TrackScript, Command]:
    """Returns the disturbed command to execute, the script, and the undisturbed one to record."""
    elapsed = script.elapsed + 1.0 / CONTROL_HZ
    s = jnp.clip(elapsed / script.duration, 0.0, 1.0)
    fraction = scripting.sloped(s)

    def way(distance: jax.Array | float) -> jax.Array:
        line = script.start + fraction * (_target(distance, state) - script.start)
        # Parabola, 1 at its middle
        return line.at[1:].add(4.0 * fraction * (1.0 - fraction) * script.side)

    noise = scripting.disturb(script.key, script.noise, state.step, jnp.array(DEVIATION))
    weight = 1.0 - (1.0 - DISTURBANCE) * s  # less once the target is in the middle
    script = script.replace(elapsed=elapsed, noise=noise)
    disturbed = way(script.distance) + weight * jnp.roll(noise[1], 1)
    return _command(disturbed, state), script, _command(way(DISTANCE), state)


def _target(distance: jax.Array | float, state: EnvState) -> jax.Array:
    """Returns roll and position `[4]` with the target centred and level at `distance`."""
    measurements = state.measurements
    # A step ahead: the command takes one
    aim = measurements.target + measurements.velocity / CONTROL_HZ
    R_tip_camera = state.pose.R[0].T @ measurements.camera.R  # fixed: the camera rides on the tip
    pose = looking_at(aim, state.measured_trocar.p_world_trocar[0], distance, R_tip_camera)
    return jnp.append(rcm.roll_of(pose.R) - state.measured_trocar.roll_zero[0], pose.p)


def _command(way: jax.Array, state: EnvState) -> Command:
    return scripting.command(way[:1], way[None, 1:], jnp.ones(1), state)


AGENT = Agent(init, act)
