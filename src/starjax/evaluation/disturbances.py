"""Disturbances of a theatre: environments that differ from the usual one by one thing.

A disturbance wraps the functions of an environment; starts, keys and judging stay, and the executed
RCM error is measured against the true trocar. What it draws depends on the episode's key alone.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.spatial.transform import Rotation

from starjax import rcm
from starjax.sim import moving
from starjax.sim.state import Env, EnvParams, EnvState
from starjax.types import Command, Observation, Pose

STREAM = 0x73747265  # folded into an episode's key
BREATH_HZ = 0.25  # breaths a second of a patient at rest
TURN_PER_MM = 0.5  # degrees that a camera is turned for each mm that it is moved


class Disturbance(NamedTuple):
    """One kind of trouble.

    Attributes:
      what: a sentence.
      unit: of its levels.
      levels: usual ones; 0 is the undisturbed environment.
      apply: (Env, level) -> Env.
      moves_cameras: whether it needs an environment whose cameras may move.
      of_images: whether policies that see no images are spared.
    """

    what: str
    unit: str
    levels: tuple[float, ...]
    apply: Callable[[Env, float], Env]
    moves_cameras: bool = False
    of_images: bool = False


def told_wrongly(env: Env, level: float) -> Env:
    """Agents are told trocars that are `level` mm from the true ones, each in some direction."""

    def reset(key: jax.Array, params: EnvParams) -> EnvState:
        p = rcm.trocar_position(params.trocar, env.p_world_ref)
        told = rcm.trocar_from_position(p + 1e-3 * level * _directions(key, p), env.p_world_ref)
        return env.reset(key, params._replace(told=told))

    return env._replace(reset=reset)


def breathing(env: Env, level: float) -> Env:
    """The trocars rise by `level` mm and fall, BREATH_HZ times a second; agents are told where
    they lie between breaths."""

    def step(state: EnvState, command: Command) -> EnvState:
        phase = 2.0 * jnp.pi * BREATH_HZ * (state.step + 1) / env.control_hz
        rise = 0.5e-3 * level * (1.0 - jnp.cos(phase))
        there = state.told.p_world_trocar + rise * jnp.array([0.0, 0.0, 1.0])
        moved = moving.trocars_to(env, state, there)
        after = env.step(moved.replace(told=state.told), command)
        return jax.tree.map(lambda old, new: jnp.where(state.done, old, new), state, after)

    return env._replace(step=step)


def camera_moved(env: Env, level: float) -> Env:
    """Every camera is `level` mm from its place, in some direction, and turned by TURN_PER_MM."""

    def reset(key: jax.Array, params: EnvParams) -> EnvState:
        state = env.reset(key, params)
        key_p, key_R = jax.random.split(jax.random.fold_in(key, STREAM))
        aside, axis = _directions(key_p, state.cameras.p), _directions(key_R, state.cameras.p)
        turn = Rotation.from_rotvec(jnp.deg2rad(TURN_PER_MM * level) * axis).as_matrix()
        R = jnp.einsum("cij,cjk->cik", state.cameras.R, turn, precision="highest")
        return state.replace(cameras=Pose(R, state.cameras.p + 1e-3 * level * aside))

    return env._replace(reset=reset)


def _seen(change: Callable[[jax.Array, float, jax.Array], jax.Array]) -> Callable[..., Env]:
    """A disturbance of every image `[h, w, 3]` in [0, 1], given the level and a key of the step."""

    def apply(env: Env, level: float) -> Env:
        def observe(state: EnvState) -> Observation:
            seen = env.observe(state)
            if seen.images is None:
                return seen
            # EnvState has no key of its own: where things are is one episode's alone
            leaves = jax.tree.leaves((state.physics.qpos, state.layout))
            places = jnp.stack([jnp.sum(jnp.nan_to_num(leaf, posinf=0.0)) for leaf in leaves])
            bits = jax.lax.bitcast_convert_type(jnp.float32(jnp.sum(places)), jnp.uint32)
            key = jax.random.fold_in(jax.random.fold_in(jax.random.key(STREAM), bits), state.step)

            def one(image: jax.Array) -> jax.Array:
                changed = change(image.astype(jnp.float32) / 255.0, level, key)
                return jnp.round(255.0 * jnp.clip(changed, 0.0, 1.0)).astype(jnp.uint8)

            return seen._replace(images=jax.tree.map(one, seen.images))

        return env._replace(observe=observe)

    return apply


def _blurred(image: jax.Array, level: float, key: jax.Array) -> jax.Array:
    """The mean over a square with `level` pixels on either side, as far as the image goes."""
    side = 2 * round(level) + 1

    def total(x: jax.Array) -> jax.Array:
        return jax.lax.reduce_window(x, 0.0, jax.lax.add, (side, side, 1), (1, 1, 1), "SAME")

    return total(image) / total(jnp.ones_like(image))


def _directions(key: jax.Array, like: jax.Array) -> jax.Array:
    """Unit vectors `[..., 3]`, uniform on the sphere."""
    drawn = jax.random.normal(jax.random.fold_in(key, STREAM), like.shape)
    return drawn / jnp.maximum(jnp.linalg.norm(drawn, axis=-1, keepdims=True), 1e-9)


DISTURBANCES: dict[str, Disturbance] = {
    "trocar_told": Disturbance(
        what="the trocar is measured wrongly",
        unit="mm",
        levels=(0.0, 1.0, 2.0, 5.0, 10.0),
        apply=told_wrongly,
    ),
    "breathing": Disturbance(
        what="the trocar moves with the breath, and nobody says so",
        unit="mm",
        levels=(0.0, 2.0, 5.0),
        apply=breathing,
    ),
    "camera": Disturbance(
        what=f"the camera has been pushed aside, and turned by {TURN_PER_MM:g} degrees a mm",
        unit="mm",
        levels=(0.0, 2.0, 5.0, 10.0),
        apply=camera_moved,
        moves_cameras=True,
        of_images=True,
    ),
    "darkness": Disturbance(
        what="the light is dimmed by this share",
        unit="",
        levels=(0.0, 0.1, 0.2, 0.4),
        apply=_seen(lambda image, level, key: (1.0 - level) * image),
        of_images=True,
    ),
    "noise": Disturbance(
        what="every colour of every pixel is noisy, with this standard deviation of its range",
        unit="",
        levels=(0.0, 0.02, 0.05, 0.1),
        apply=_seen(lambda image, level, key: image + level * jax.random.normal(key, image.shape)),
        of_images=True,
    ),
    "blur": Disturbance(
        what="the picture is out of focus, by so many pixels on either side",
        unit="px",
        levels=(0.0, 1.0, 2.0),
        apply=_seen(_blurred),
        of_images=True,
    ),
    "smoke": Disturbance(
        what="white smoke hides this share of what is seen",
        unit="",
        levels=(0.0, 0.1, 0.25, 0.5),
        apply=_seen(lambda image, level, key: (1.0 - level) * image + level),
        of_images=True,
    ),
}


def disturbed(env: Env, name: str, level: float) -> Env:
    """The environment with a disturbance at a level; at 0 as it is."""
    return DISTURBANCES[name].apply(env, level) if level else env
