"""Labels of the rescuer of needle hand-over are those of the demonstration that it enters."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax import rcm
from starjax.addons.finetune.rescuers import needle_handover as rescue
from starjax.data import stillness
from starjax.sim import env as envs
from starjax.sim.task import CONTROL_HZ
from starjax.tasks.needle_handover import expert

STEPS, LANES, EVERY, HORIZON = 400, 6, 5, 8
GRIP = -0.5  # opening of jaws about a wire
KEYS = jax.random.split(jax.random.key(11), LANES)
PHASES = {name: number for number, name in enumerate(expert.PHASES)}


def moved(state, command):
    """The state a step later without physics: tips follow, and jaws on the wire take it along."""
    needle, tips = state.measurements.needle, command.pose.p
    wire = needle.p + jnp.asarray(expert.MIDDLES) @ needle.R.T
    off = jnp.linalg.norm(state.pose.p[:, None] - wire, axis=-1).min(axis=-1)
    touch = (command.gripper < GRIP) & (off < 2e-3)
    by = tips - state.pose.p
    taken = jnp.where(touch[0], by[0], jnp.where(touch[1], by[1], 0.0))
    velocity = jnp.zeros_like(state.velocity).at[:, :3].set(CONTROL_HZ * by)
    measurements = state.measurements.replace(
        needle=needle._replace(p=needle.p + taken), tips=tips, touch=touch
    )
    return state.replace(
        pose=command.pose,
        velocity=velocity,
        gripper_target=command.gripper,
        gripper=jnp.where(touch, jnp.maximum(command.gripper, GRIP), command.gripper),
        touch=touch,
        measurements=measurements,
        step=state.step + 1,
    )


@pytest.fixture(scope="module")
def played():
    """Demonstrations `[LANES, STEPS]`: states, phases and undisturbed commands."""
    environment = envs.make("needle_handover", observation="state")
    rows = np.linspace(0, len(environment.task.is_seen) - 1, LANES).astype(int)
    trocars = jax.tree.map(lambda field: jnp.asarray(field[rows]), environment.task.trocars)
    first = jax.jit(jax.vmap(environment.reset))(KEYS, envs.EnvParams(rcm.Trocar(*trocars)))

    def step(carry, _):
        memory, state = carry
        _, memory, label = expert.AGENT.act(memory, state)
        return (memory, moved(state, label)), (state, memory.phase, label)

    @jax.jit
    @jax.vmap
    def episode(key, state):
        return jax.lax.scan(step, (expert.AGENT.init(key, state), state), None, STEPS)[1]

    return episode(KEYS, first)


def test_demonstrations_go_through_all_phases_and_never_stand_still(played):
    _, phases, label = jax.device_get(played)
    for lane in range(LANES):
        assert set(phases[lane]) == set(PHASES.values())
        end = np.argmax(phases[lane] == PHASES["hold"])
        command = jax.tree.map(lambda x, n=lane, end=end: x[n, :end], label)
        assert stillness.stretches(stillness.still_steps(command)).max() <= stillness.MOST


def test_jaws_are_waited_for_two_steps_longer_than_they_move(played):
    _, phases, label = jax.device_get(played)
    for name, arm in {"close": 0, "take": 1, "open": 0}.items():
        for lane in range(LANES):
            during = np.flatnonzero(phases[lane] == PHASES[name])
            opening = label.gripper[lane, during[0] - 1 : during[-1] + 1, arm]
            moves = np.abs(np.diff(opening)) > stillness.JAW
            assert moves.any() and len(during) <= moves.sum() + 2


def test_labels_are_those_of_the_demonstration(played):
    state, phases, label = played
    at = [
        (n, t)
        for n in range(LANES)
        for t in range(0, STEPS - HORIZON, EVERY)
        if phases[n, t] < PHASES["raise"]
    ]

    @jax.jit
    @jax.vmap
    def entered(n, t):
        here = jax.tree.map(lambda x: x[n, t], state)
        memory = rescue.RESCUER.resume(KEYS[n], here)

        def step(memory, k):
            now = jax.tree.map(lambda x: x[n, t + k], state)
            _, memory, ours = rescue.RESCUER.act(memory, now)
            return memory, ours

        return jax.lax.scan(step, memory, jnp.arange(HORIZON))[1]

    lanes, times = map(np.asarray, zip(*at, strict=True))
    ours = jax.device_get(entered(lanes, times))
    steps = times[:, None] + np.arange(HORIZON)
    theirs = jax.tree.map(lambda x: np.asarray(x)[lanes[:, None], steps], label)
    off = np.linalg.norm(ours.pose.p - theirs.pose.p, axis=-1).max(axis=(1, 2))
    turn = np.linalg.norm(ours.pose.R - theirs.pose.R, axis=(-2, -1)).max(axis=(1, 2)) / np.sqrt(2)
    jaws = np.abs(ours.gripper - theirs.gripper).max(axis=(1, 2))
    for name, number in PHASES.items():
        here = np.asarray(phases)[lanes, times] == number
        if here.any():
            assert np.quantile(off[here], 0.9) < 1.2e-3, name
            assert np.quantile(turn[here], 0.9) < 0.05, name
            assert np.quantile(jaws[here], 0.9) < 0.3, name
