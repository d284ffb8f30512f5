"""Checks of a disturbance: its levels; nothing changes at level 0, and numbers at the highest."""

import itertools
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm
from starjax.core.types import ArrayTree, Command, Observation
from starjax.evaluation.disturbances import DISTURBANCES
from starjax.evaluation.disturbances import base as disturbances
from starjax.evaluation.disturbances.base import Disturbance
from starjax.sim import env as envs
from starjax.sim.state import EnvState
from starjax.sim.task import CONTROL_HZ
from starjax.testing.base import NOTE, Check, attempt, verdict

TASK = "reach"
STEPS = 8  # control steps of an episode that moves down
HOLD = 40  # control steps at rest, longer than success takes
DOWN = jnp.array([0.0, 0.0, -0.001])  # m a control step
BRIGHTEST = 2.0  # mean of an image's numbers, which are cut to [0, 1] afterwards
TOLERANCE = 1e-5  # m, rad: two compiled programs round differently
SIDE = 32  # pixels
# Compared of a state.
FIELDS = (
    "pose",
    "gripper",
    "trocar",
    "measured_trocar",
    "cameras",
    "layout",
    "success",
    "loose",
    "collided",
    "step",
    "lost",
    "invalid",
)


def check(name: str, n: int) -> Iterator[Check]:
    """Yields the checks of a disturbance in the task `reach`; `n` is not used."""
    fault, kind = attempt("record", lambda: DISTURBANCES.get(name))
    if fault:
        yield fault
        return
    yield verdict(
        "levels", _levels(kind), f"{len(kind.levels)} up to {kind.levels[-1]:g} {kind.unit}"
    )
    if kind.on_image is not None:
        yield verdict("images", _images(kind), "as they were at level 0, finite and in range")
    if kind.seen_step is not None:
        yield verdict("seen steps", _seen_steps(kind), "the same at level 0, never later ones")
    env = envs.make(TASK, observation="state")
    fault, other = attempt("functions", lambda: disturbances.with_disturbances(env, [name]))
    if not fault:
        fault, runs = attempt("functions", lambda: _run_all(env, other, name, kind))
    if fault:
        yield fault
        return
    plain, none, most = runs
    yield verdict("level 0", _differences(plain, none), "changes nothing")
    faults = [*_not_finite(most), *_stopped(most)]
    yield verdict(f"level {kind.levels[-1]:g}", faults, "finite numbers, time advances")
    yield verdict("success", _easier(plain, most), "none without an agent")
    if not kind.image_only and not any(_differences(plain, most)):
        yield Check("effect", f"none on {STEPS + HOLD} steps of {TASK} at the highest level", NOTE)


def _levels(kind: Disturbance) -> Iterator[str]:
    levels = kind.levels
    if not levels or levels[0] != 0.0:
        yield f"expected 0 as the first, got {levels}"
    if any(not a < b for a, b in itertools.pairwise(levels)):
        yield f"expected them to rise, got {levels}"
    if levels and levels[-1] > kind.max_level:
        yield f"{levels[-1]} is above max_level {kind.max_level}"


def _images(kind: Disturbance) -> Iterator[str]:
    assert kind.on_image is not None
    image = jax.random.randint(jax.random.key(0), (SIDE, SIDE, 3), 0, 256, jnp.uint8)
    for level in (0.0, kind.levels[-1]):
        state = disturbances.DisturbanceState(jnp.float32(level), jax.random.key(1))
        changed = disturbances.change_image(kind, state, image, jnp.zeros((), jnp.int32))
        if changed.shape != image.shape:
            yield f"on_image: expected {list(image.shape)}, got {list(changed.shape)}"
        elif not level and not np.array_equal(changed, image):
            yield "on_image changes them at level 0"
        real = image.astype(jnp.float32) / 255.0
        mean = float(jnp.mean(kind.on_image(state, real, jnp.zeros((), jnp.int32))))
        if not abs(mean) <= BRIGHTEST:
            got = f"got {mean:.3g}"
            yield f"on_image: expected a mean of 0 to 1 (at most {BRIGHTEST:g}) at {level:g}, {got}"


def _seen_steps(kind: Disturbance) -> Iterator[str]:
    assert kind.seen_step is not None
    for level in (0.0, kind.levels[-1]):
        state = disturbances.DisturbanceState(jnp.float32(level), jax.random.key(1))
        for step in range(STEPS):
            seen = int(kind.seen_step(state, jnp.int32(step)))
            if not 0 <= seen <= step or (not level and seen != step):
                yield f"seen_step shows step {seen} at step {step}, level {level:g}"


def _run_all(env: envs.Env, other: envs.Env, name: str, kind: Disturbance) -> tuple[Any, Any, Any]:
    """Returns an undisturbed episode, one at level 0 and one at the highest level."""
    disturbed = jax.jit(lambda level: _run(other, {name: level}))
    plain = jax.jit(lambda: _run(env, None))()
    return plain, disturbed(jnp.float32(0.0)), disturbed(jnp.float32(kind.levels[-1]))


def _run(env: envs.Env, levels: dict[str, jax.Array] | None) -> tuple[dict[str, Any], Observation]:
    """Returns state and observation after `STEPS` control steps down and `HOLD` at rest."""
    trocar = rcm.Trocar(*(jnp.asarray(field[0]) for field in env.task.trocars))
    state = env.reset(jax.random.key(0), envs.EnvParams(trocar, levels=levels))

    def step(state: EnvState, _: None) -> tuple[Any, None]:
        down = jnp.where(state.step < STEPS, DOWN, 0.0)
        pose = state.pose._replace(p=state.pose.p + down)
        return env.step(state, Command(pose, state.gripper)), None

    state, _ = jax.lax.scan(step, state, None, STEPS + HOLD)
    return {name: getattr(state, name) for name in FIELDS}, env.observe(state)


def _differences(a: ArrayTree, b: ArrayTree) -> Iterator[str]:
    """Yields the leaves in which two episodes differ."""
    first, second = (dict(jax.tree_util.tree_leaves_with_path(tree)) for tree in (a, b))
    for path, leaf in first.items():
        name = jax.tree_util.keystr(path)
        if path not in second or np.shape(second[path]) != np.shape(leaf):
            yield f"{name} has another shape"
        elif not np.allclose(leaf, second[path], 0, TOLERANCE, equal_nan=True):
            yield f"{name} changes"


def _easier(plain: Any, most: Any) -> Iterator[str]:
    """Yields outcomes that an arm reaches under the disturbance alone."""
    for name in ("success", "loose"):
        if bool(most[0][name]) and not bool(plain[0][name]):
            seconds = (STEPS + HOLD) / CONTROL_HZ
            yield f"{name} at the highest level of an arm that holds for {seconds:.1f} s"


def _stopped(episode: Any) -> Iterator[str]:
    """Yields a fault if an episode that is not over has had fewer steps than commands."""
    state, _ = episode
    is_over = any(bool(state[name]) for name in ("success", "lost", "invalid"))
    if not is_over and (step := int(state["step"])) != STEPS + HOLD:
        yield f"the state is at step {step} after {STEPS + HOLD} commands"


def _not_finite(episode: Any) -> Iterator[str]:
    for path, leaf in jax.tree_util.tree_leaves_with_path(episode):
        if np.issubdtype(leaf.dtype, np.floating) and not np.isfinite(leaf).all():
            yield f"{jax.tree_util.keystr(path)} is not finite"
