"""Scripted expert of bimanual peg transfer: lift, meet in the air, take over, thread.

Both tools hold the same wall, `SIDE` to either side of its middle; their shafts lean apart and both
jaws open along the world's y. Wanted positions never look at a trocar. It has no second try: a
block that is dropped is a failure.
"""

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm
from starjax.sim.state import EnvState
from starjax.sim.tasks import scripting
from starjax.sim.tasks.base import CONTROL_HZ
from starjax.sim.tasks.peg_transfer import task as single
from starjax.sim.tasks.peg_transfer_bimanual.task import PARK
from starjax.types import Agent, Command

PHASES = (
    "above", "down", "close", "lift", "carry", "near", "meet", "take", "open", "away",
    "over", "lower", "release", "rise", "wait",
)  # fmt: skip
# s, of each phase at tempo 1; jaws of both arms at its end.
DURATION = (1.6, 1.1, 0.5, 0.9, 1.0, 0.9, 0.8, 0.5, 0.4, 0.6, 1.2, 0.9, 0.5, 0.7, 0.5)
GIVER = (1, 1, -1, -1, -1, -1, -1, -1, 1, 1, 1, 1, 1, 1, 1)
TAKER = (1, 1, 1, 1, 1, 1, 1, -1, -1, -1, -1, -1, 1, 1, 1)
# Which arms turn to the wall in which phase; the others keep their turn.
LOOKS = np.zeros((len(PHASES), 2), bool)
LOOKS[[0, 1], 0] = LOOKS[[5, 6, 10, 11], 1] = True
# How much of the disturbance acts.
DISTURBANCE = (1, 0.4, 0, 0.1, 0.3, 0.3, 0.1, 0, 0, 0, 0.3, 0.1, 0, 0.3, 0)

TEMPO = (0.9, 1.15)  # range of an episode's pace
JAW_TIME = 0.25  # s to close or open
# 1/m, how much turn (its sine) it is worth to hold the wall that the block's way leads away from: a
# block sinks about the wall that holds it, and on its way shafts lean so as to raise it again.
RAISED = 5.0
SIDE = 0.0048  # m along the wall, from its middle to either tool
PLACE = (0.0, 0.0, 0.045)  # m, of the block at the hand-over
HOVER = 0.026  # m above a grasp
GRASP_DROP = 0.001  # m below the rim's centre line
OVER = 0.012  # m more above the target: the block hangs below the taker
RELEASE_HEIGHT = 0.0012  # m above the grasp's height at which the block is let go
RELEASE_SHIFT = 0.0005  # m further out along the wall's normal: room for the inner pad
COME = (0.0125, 0.0, 0.0215)  # m, from where the taker comes to the wall
GO = (-0.015, 0.0, 0.026)  # m, where the giver goes once it has let go
DEVIATION = (0.001, 0.001, 0.001, 0.04)  # m and rad, of the disturbance of each arm
CORRELATION, SMOOTHING = 0.4, 0.15  # s


@flax.struct.dataclass
class Script:
    """Where the script stands; single episode. Arrays `[2, ...]` are of both arms.

    Attributes:
      key: of everything random. phase: int32. elapsed: s. tempo: pace.
      wall, along: `[3]`, normal and direction of the wall held, in the block's frame.
      start, goal, p: `[2, 3]` m, undisturbed positions. normal: `[2, 3]`, what the jaws open along.
      roll_from, roll_to, roll: `[2]` rad. jaws_from, jaws: `[2]`.
      noise: `[2, 8]` disturbance of both arms, rough and smooth.
    """

    key: jax.Array
    phase: jax.Array
    elapsed: jax.Array
    tempo: jax.Array
    wall: jax.Array
    along: jax.Array
    start: jax.Array
    goal: jax.Array
    p: jax.Array
    normal: jax.Array
    roll_from: jax.Array
    roll_to: jax.Array
    roll: jax.Array
    jaws_from: jax.Array
    jaws: jax.Array
    noise: jax.Array


def init(key: jax.Array, state: EnvState) -> Script:
    """Chooses the wall, one of little turn from which the block will hang well, and the pace."""
    key, key_tempo = jax.random.split(key)
    block, p = state.facts.block, state.pose.p
    normals = single.wall_normals(block)
    way = state.layout.target_peg[1] - block.p[1]
    out = normals[jnp.argmin(jnp.abs(normals[:, 0]) + RAISED * way * normals[:, 1])]
    along = jnp.cross(block.R[:, 2], out)
    along = along * jnp.where(along[0] < 0, -1.0, 1.0)
    zero, open_ = jnp.zeros(2), jnp.ones(2)
    down = jnp.tile(jnp.array([0.0, -1.0, 0.0]), (2, 1))
    script = Script(
        key=key,
        phase=jnp.zeros((), jnp.int32),
        elapsed=jnp.zeros(()),
        tempo=jax.random.uniform(key_tempo, minval=TEMPO[0], maxval=TEMPO[1]),
        wall=block.R.T @ out,
        along=block.R.T @ along,
        start=p,
        goal=p,
        p=p,
        normal=down,
        roll_from=zero,
        roll_to=zero,
        roll=zero,
        jaws_from=open_,
        jaws=open_,
        noise=jnp.zeros((2, 8)),
    )
    return _enter(script, jnp.zeros((), jnp.int32), state)


def act(script: Script, state: EnvState) -> tuple[Command, Script, Command]:
    """The disturbed commands to execute, the script, and the undisturbed ones to record."""
    dt = 1.0 / CONTROL_HZ
    duration = jnp.asarray(DURATION)[script.phase] / script.tempo
    is_over = script.elapsed >= duration - 1e-6
    following = jnp.minimum(script.phase + 1, len(PHASES) - 1)
    after = _enter(script, following, state)
    script = jax.tree.map(lambda a, b: jnp.where(is_over, a, b), after, script)
    elapsed = script.elapsed + dt
    s = jnp.clip(elapsed * script.tempo / jnp.asarray(DURATION)[script.phase], 0.0, 1.0)
    share = scripting.minimum_jerk(s)
    wanted = jnp.stack([jnp.asarray(GIVER), jnp.asarray(TAKER)], -1)[script.phase]
    noise = scripting.disturb(
        script.key,
        script.noise,
        state.step,
        deviation=jnp.array(DEVIATION * 2),
        correlation=CORRELATION,
        smoothing=SMOOTHING,
        dt=dt,
    )
    script = script.replace(
        elapsed=elapsed,
        p=script.start + share * (script.goal - script.start),
        roll=script.roll_from + share * (script.roll_to - script.roll_from),
        jaws=script.jaws_from
        + jnp.clip(elapsed / JAW_TIME, 0.0, 1.0) * (wanted - script.jaws_from),
        noise=noise,
    )
    weight = jnp.asarray(DISTURBANCE, jnp.float32)[script.phase]
    moved = weight * noise[1].reshape(2, 4)
    rough = _command(script.roll + moved[:, 3], script.p + moved[:, :3], script.jaws, state)
    return rough, script, _command(script.roll, script.p, script.jaws, state)


def _enter(script: Script, phase: jax.Array, state: EnvState) -> Script:
    """Begins `phase` with goals from what is seen now."""
    block, tips = state.facts.block, script.p
    out, along = block.R @ script.wall, block.R @ script.along
    flat = out * jnp.array([1.0, 1.0, 0.0])
    flat = flat / jnp.maximum(jnp.linalg.norm(flat), 1e-6)
    normal = flat * jnp.where(flat[1] > 0, -1.0, 1.0)
    low = jnp.array([0.0, 0.0, -GRASP_DROP])
    give, take = (
        block.p + single.RIM_RADIUS * out + side * SIDE * along + low for side in (-1.0, 1.0)
    )
    park, up = jnp.array(PARK), jnp.array([0.0, 0.0, HOVER])
    carried = tips[0] + jnp.array(PLACE) - block.p
    # Where the taker must be once the block is pressed upright over the target peg.
    beside = jnp.array([-flat[1], flat[0]])
    aside = ((state.pose.p[1] - block.p)[:2] @ beside) * beside
    over = state.layout.target_peg + (single.RIM_RADIUS + RELEASE_SHIFT) * flat[:2] + aside
    height = single.RIM_HEIGHT - GRASP_DROP
    held = tips
    goals = jnp.stack(
        [
            jnp.stack([give + up, park[1]]),
            jnp.stack([give, park[1]]),
            held,
            held.at[0].add(up),
            jnp.stack([carried, park[1]]),
            jnp.stack([tips[0], take + jnp.array(COME)]),
            jnp.stack([tips[0], take]),
            held,
            held,
            held.at[0].add(jnp.array(GO)),
            jnp.stack([park[0], jnp.append(over, height + HOVER + OVER)]),
            jnp.stack([park[0], jnp.append(over, height + RELEASE_HEIGHT)]),
            held,
            held.at[1].add(up),
            held,
        ]
    )
    goal = goals[phase]
    normals = jnp.where(jnp.asarray(LOOKS)[phase][:, None], normal, script.normal)
    at_zero = _command(jnp.zeros(2), goal, script.jaws, state).pose.R
    across = jnp.einsum("ai,aij->aj", normals, at_zero, precision="highest")
    turned = jnp.arctan2(-across[:, 0], across[:, 1])
    # Jaws are the same after half a turn: the nearer of the two.
    roll_to = script.roll + (turned - script.roll + jnp.pi / 2) % jnp.pi - jnp.pi / 2
    return script.replace(
        phase=phase,
        elapsed=jnp.zeros(()),
        start=tips,
        goal=goal,
        normal=normals,
        roll_from=script.roll,
        roll_to=roll_to,
        jaws_from=script.jaws,
    )


def _command(roll: jax.Array, p: jax.Array, jaws: jax.Array, state: EnvState) -> Command:
    pose, _ = rcm.ACTION_SPACES["rcm4"].decode(jnp.concatenate([roll[:, None], p], -1), state.told)
    return Command(pose, jaws)


AGENT = Agent(init, act)
