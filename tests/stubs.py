"""A point mass for each arm instead of the simulator, with an expert and a policy: programs of a
second."""

import types
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm
from starjax.core.types import Agent, Command, Observation, Pose
from starjax.sim import names, render
from starjax.sim import rescuer as rescue
from starjax.sim import task as base
from starjax.sim.state import ImageSource

P_WORLD_REF = np.array([[0.0, 0.0, 0.15], [0.02, 0.1, 0.16]], np.float32)
ROLL_ZERO = (0.0, float(np.pi))
SPEED = 0.004  # m a control step
CAMERA = "camera"


class Physics(NamedTuple):
    """Stands for the simulator's state."""

    qpos: jax.Array


@flax.struct.dataclass
class State:
    """The fields of `sim.env.EnvState` that others read."""

    physics: Physics
    trocar: rcm.TrocarFrame
    measured_trocar: rcm.TrocarFrame
    layout: Any
    measurements: Any
    step: jax.Array
    done: jax.Array
    success: jax.Array
    loose: jax.Array
    lost: jax.Array
    invalid: jax.Array
    collided: jax.Array
    stage: jax.Array
    reward: jax.Array
    settled: jax.Array
    rcm_error: jax.Array
    rcm_error_within: jax.Array
    pose: Pose
    gripper: jax.Array
    cameras: Any = None
    model: Any = flax.struct.field(default_factory=dict)
    wrapper_state: Any = flax.struct.field(default_factory=dict)
    endoscope: Any = None
    shaft: Any = None
    wrist: Any = None
    commanded_shaft: Any = None
    has_look: Any = None

    @property
    def coordinates(self) -> jax.Array:
        """Generalised coordinates, those of a scene without a thread."""
        return self.physics.qpos


class Layout(NamedTuple):
    """What is drawn at reset: goals `[A, 3]` m, and labels."""

    goal: jax.Array
    labels: dict[str, jax.Array]


class Env(NamedTuple):
    """The fields of `sim.env.Env` that others use."""

    reset: Any
    step: Any
    observe: Any
    camera: Any
    draw: Any
    labels: Any
    scene: Any
    task: base.Task
    names: names.SceneNames
    p_world_ref: np.ndarray
    control_hz: float


def make_task(arms: int = 1) -> base.Task:
    """Reach a goal, in as much of a task as collecting and evaluating look at."""
    given = {
        "name": "reach",
        "slots": tuple(
            base.Slot("board", tuple(ref.tolist()), roll)
            for ref, roll in zip(P_WORLD_REF[:arms], ROLL_ZERO)
        ),
        "cameras": (CAMERA,),
        "fields": (
            base.Field("goal.p", 3, "point"),
            base.Field("none.R", 6, "rot6d"),
            base.Field("again.p", 3, "point"),
        ),
        "labels": ("source", "target"),
        "stages": ("far", "near"),
        "experts": {"default": lambda: EXPERT, "one_wall": lambda: EXPERT},
        "label": lambda layout: layout.labels,
        "relative": lambda state, tips: state[..., None, :3] - tips,
        "trocars": trocars(*range(12), arms=arms),
        "is_seen": rcm.IS_SEEN,
        "least_steps": 0,
    }
    given["stalled_s"] = base.Task._field_defaults["stalled_s"]
    return base.Task(**{**dict.fromkeys(base.Task._fields), **given})


def make_env(
    observation: str = "state", unlucky: float = 0.25, arms: int = 1, cameras: tuple = (CAMERA,)
) -> Env:
    """Every tip must reach its goal; one episode in `1 / unlucky` ends invalid on the way."""
    p_world_ref, roll_zero = P_WORLD_REF[:arms], np.array(ROLL_ZERO[:arms], np.float32)

    def reset(key, params):
        key_goal, key_luck, key_peg = jax.random.split(key, 3)
        goal = jax.random.uniform(key_goal, (arms, 3), minval=-0.05, maxval=0.05)
        fate = jnp.where(jax.random.uniform(key_luck) < unlucky, 5.0, jnp.inf)
        p = jnp.tile(jnp.array([0.0, 0.0, 0.02]), (arms, 1))
        no = jnp.zeros((), bool)
        labels = {
            "source": jax.random.randint(key_peg, (), 0, 6),
            "target": jax.random.randint(key_peg, (), 6, 12),
        }
        trocar = rcm.trocar_frame(params.trocar, p_world_ref, roll_zero)
        measured_trocar = getattr(params, "measured_trocar", None)
        return State(
            physics=Physics(jnp.append(p.reshape(-1), fate)),
            trocar=trocar,
            measured_trocar=trocar
            if measured_trocar is None
            else rcm.trocar_frame(measured_trocar, p_world_ref, roll_zero),
            layout=Layout(goal, labels),
            measurements=(),
            step=jnp.zeros((), jnp.int32),
            done=no,
            success=no,
            loose=no,
            lost=no,
            invalid=no,
            collided=no,
            stage=jnp.zeros((), jnp.int32),
            reward=jnp.zeros(()),
            settled=jnp.zeros((), jnp.int32),
            rcm_error=jnp.zeros(arms),
            rcm_error_within=jnp.zeros(arms),
            pose=Pose(jnp.tile(jnp.eye(3), (arms, 1, 1)), p),
            gripper=jnp.ones(arms),
        )

    def step(state, command):
        delta = command.pose.p - state.pose.p
        far = jnp.linalg.norm(delta, axis=-1)
        p = state.pose.p + delta * jnp.minimum(1.0, SPEED / jnp.maximum(far, 1e-9))[:, None]
        away = jnp.max(jnp.linalg.norm(p - state.layout.goal, axis=-1))
        success = away < 0.004
        invalid = state.step.astype(jnp.float32) >= state.physics.qpos[-1]
        after = state.replace(
            physics=Physics(state.physics.qpos.at[:-1].set(p.reshape(-1))),
            step=state.step + 1,
            success=success & ~invalid,
            loose=state.loose | (away < 0.008),
            invalid=invalid,
            done=success | invalid,
            collided=state.collided | (p[:, 2] < -0.03).any(),
            stage=(away < 0.02).astype(jnp.int32),
            rcm_error=0.1 * far,
            rcm_error_within=0.2 * far,
            pose=Pose(command.pose.R, p),
            gripper=command.gripper,
        )
        return jax.tree.map(lambda old, new: jnp.where(state.done, old, new), state, after)

    def draw(source):
        pixels = jnp.concatenate([source.qpos[:3], source.layout.goal[0]]) * 1000 + 128
        image = jnp.broadcast_to(pixels[:, None, None], (6, 6, 3)).astype(jnp.uint8)
        return {name: render.CameraImage(image + i) for i, name in enumerate(cameras)}

    def camera(state):
        at = state.trocar.p_world_trocar
        return draw(ImageSource(state.physics.qpos, at, state.layout, state.cameras))

    def observe(state):
        goal, images, low = state.layout.goal[0], None, None
        if observation == "image":
            images = {name: frame.rgb for name, frame in camera(state).items()}
        else:
            low = jnp.concatenate([goal, jnp.zeros(6), goal])
        return Observation(state.pose, state.gripper, images, low)

    return Env(
        reset,
        step,
        observe,
        camera=camera,
        draw=draw,
        labels=lambda state: state.layout.labels,
        scene=types.SimpleNamespace(arms=()),
        task=make_task(arms),
        names=names.SceneNames("reach", ("point",) * arms, ("tip",) * arms, tuple(cameras)),
        p_world_ref=p_world_ref,
        control_hz=30.0,
    )


def trocars(*rows: int, arms: int = 1) -> rcm.Trocar:
    """Rows of the twelve, fields `[C, A]`: each arm has them in another order."""
    return rcm.Trocar(
        *(np.stack([np.roll(x[list(rows)], a) for a in range(arms)], -1) for x in rcm.TROCARS)
    )


def measured_above() -> types.SimpleNamespace:
    """A measured trocar above the middle of the board."""
    return types.SimpleNamespace(
        p_world_trocar=jnp.array([[0.0, 0.0, 0.15]]), roll_zero=jnp.zeros(1)
    )


def one_tool(tip: Pose, measurements: Any, layout: Any) -> types.SimpleNamespace:
    """A state, as scripts of one arm read it: closed jaws at `tip` that touch something."""
    return types.SimpleNamespace(
        pose=Pose(tip.R[None], tip.p[None]),
        measurements=measurements,
        layout=layout,
        measured_trocar=measured_above(),
        gripper_target=-jnp.ones(1),
        gripper=-0.5 * jnp.ones(1),
        touch=jnp.ones(1, bool),
        step=jnp.asarray(50),
    )


def _act(key, state):
    key, key_noise = jax.random.split(key)
    noise = 0.002 * jax.random.normal(key_noise, state.pose.p.shape)
    delta = state.layout.goal + noise - state.pose.p
    far = jnp.linalg.norm(delta, axis=-1, keepdims=True)
    p = state.pose.p + delta * jnp.minimum(1.0, SPEED / jnp.maximum(far, 1e-9))
    command = Command(Pose(state.pose.R, p), jnp.ones_like(state.gripper))
    return command, key, command


# Walks to the goals, with noise from its key.
EXPERT = Agent(lambda key, state: key, _act)
RESCUER = rescue.Rescuer(EXPERT.init, EXPERT.act)


def make_policy(horizon: int = 6, width: int = 64) -> tuple[Any, Any]:
    """`Policy.sample` of a network with noise from the keys, which steers all arms to the goal that
    it sees; and its parameters."""
    keys = jax.random.split(jax.random.key(7), 2)
    params = [
        0.3 * jax.random.normal(keys[0], (26, width)),
        0.0005 * jax.random.normal(keys[1], (width, 3)),
    ]

    def sample(params, stats, keys, observation, measured_trocar):
        count, seen = observation.gripper.shape[:2]
        noise = jax.vmap(lambda key: jax.random.normal(key, (2,)))(keys)
        flat = observation.state.reshape(count, 12 * seen)
        hidden = jnp.tanh(jnp.concatenate([flat, noise], -1)[:, :26] @ params[0])
        error = hidden @ params[1] * stats
        last = jax.tree.map(lambda x: x[:, -1], observation)
        ahead = jnp.arange(1, horizon + 1, dtype=jnp.float32)[:, None, None]
        delta = ((last.state[:, :3] + error)[:, None] - last.pose.p)[:, None]
        far = jnp.linalg.norm(delta, axis=-1, keepdims=True)
        p = last.pose.p[:, None] + delta * jnp.minimum(1.0, SPEED * ahead / jnp.maximum(far, 1e-9))
        R = jnp.broadcast_to(last.pose.R[:, None], (*p.shape, 3))
        return Command(Pose(R, p), jnp.ones(p.shape[:-1]))

    return sample, params
