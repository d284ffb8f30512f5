"""What every task of the registry owes: sizes, ranges, and an expert that succeeds."""

import xml.etree.ElementTree as ElementTree

import contacts
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from starjax import rcm
from starjax.data import stillness
from starjax.sim import assets, mjcf_parts, registries, scene
from starjax.sim import env as envs
from starjax.tasks.needle_pick import task as needle

LANES = 4
# Peg transfer's own tests run its expert through every trocar.
EXPERTS = {  # control steps
    "reach": 120,
    "needle_pick": 240,
    "peg_transfer_bimanual": 460,
    "endoscope_track": 880,
    "needle_handover": 460,
    "ring_on_wire": 460,
    "needle_regrasp": 300,
    "needle_drive": 300,
    "suture_throw": 1150,
}
# The script with two arms has no second try, and drops a block now and then.
DROPS = {"peg_transfer_bimanual": 1}
# needle_handover and needle_pick stand for them in each run.
LONG = {"needle_drive", "needle_regrasp", "suture_throw", "peg_transfer_bimanual", "ring_on_wire"}
# A pad that lies across the arc touches more of its segments than are kept, the nearest.
CROWDED = {"needle_pick", "needle_handover", "needle_regrasp"}
LOOKS = 10  # control steps between two looks at all contacts


@pytest.mark.parametrize("name", registries.tasks.names())
def test_a_task_is_what_it_says(name):
    task = registries.tasks.get(name)
    assert task.name == name and task.cameras and task.time_limit_s > 0 and task.experts
    m = scene.compose(scene.name(name))
    bound = task.bind(m)
    layout = task.sample(bound, jax.random.key(0))
    tips = task.tips(bound, layout, jnp.array([slot.p_world_ref for slot in task.slots]))
    assert tips.shape == (task.arms, 3) and set(task.label(layout)) == set(task.labels)
    rcm.check_trocar(task.trocars)
    assert task.trocars.radius.shape == (len(task.is_seen), task.arms)
    seen = np.flatnonzero(task.is_seen)
    np.testing.assert_array_equal(seen, np.arange(len(seen)))  # the seen ones come first
    state = jnp.zeros((2, 5, task.state_size))
    relative = task.relative(state, jnp.zeros((2, 5, task.arms, 3)))
    assert relative.shape[:2] == (2, 5) and bool(jnp.isfinite(relative).all())
    for limit in mjcf_parts.CONTACT_LIMITS:
        assert m.numeric(limit).data == sum(said_by_parts(task, limit))


def said_by_parts(task, limit):
    """Contribution of each part's MJCF, with included files, to a limit of the scene."""
    parts = [assets.path(task.mjcf)]
    for slot in task.slots:
        parts += [assets.path(registries.arms.get(slot.arm).mjcf)]
        parts += [assets.path(registries.tools.get(slot.tool).mjcf)]
    while parts:
        part = parts.pop()
        root = ElementTree.parse(part).getroot()
        parts += [part.parent / other.attrib["file"] for other in root.iter("include")]
        found = (row for row in root.iter("numeric") if row.get("name") == limit)
        yield from (float(row.attrib["data"]) for row in found)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=[pytest.mark.release] if n in LONG else []) for n in EXPERTS],
)
def test_the_expert_of_a_task_succeeds(name):
    environment = envs.make(name, observation="state")
    task, agent = environment.task, environment.task.expert()
    rows = np.linspace(0, len(task.is_seen) - 1, LANES).astype(int)
    trocars = jax.tree.map(lambda field: jnp.asarray(field[rows]), task.trocars)
    keys = jax.random.split(jax.random.key(7), LANES)
    state = jax.jit(jax.vmap(environment.reset))(keys, envs.EnvParams(trocars))
    memory = jax.jit(jax.vmap(agent.init))(keys, state)
    if name in registries.rescuers.names():
        enters_like_the_expert(agent, registries.rescuers.get(name), keys, state)

    @jax.jit
    @jax.vmap
    def drive(state, memory):
        command, memory, label = agent.act(memory, state)
        return environment.step(state, command), memory, label

    looks, labels = [], []
    for step in range(EXPERTS[name]):
        state, memory, label = drive(state, memory)
        labels.append(label)
        looks += [] if step % LOOKS else [state.physics.qpos]
        assert ((state.reward >= 0) & (state.reward <= 1)).all()
        assert (state.stage >= 0).all() and (state.stage < len(task.stages)).all()
        if bool(state.done.all()):
            break
    won = np.asarray(state.success)
    assert won.sum() >= LANES - DROPS.get(name, 0) and not state.invalid.any()
    assert (np.asarray(state.reward)[won] == 1.0).all()
    assert float(state.rcm_error_within[won].max()) < 0.5e-3
    commands = jax.tree.map(lambda *steps: np.stack(steps, 1), *labels)
    for lane in np.flatnonzero(won & (task.settle_steps > 1)):  # else it follows an object
        before = int(state.step[lane]) - task.settle_steps
        moves = jax.tree.map(lambda x, n=lane, end=before: x[n, :end], commands)
        assert stillness.stretches(stillness.still_steps(moves)).max(initial=0) <= stillness.MOST
    fields = jax.vmap(environment.observe)(state).state
    assert fields is not None and fields.shape == (LANES, task.state_size)
    asked = contacts.asked(environment.scene, looks, state.trocar.p_world_trocar)
    fits = np.less_equal(asked, contacts.held(environment.scene))
    assert (not fits[0]) == (name in CROWDED) and (fits[1] or name in CROWDED), asked


def enters_like_the_expert(agent, rescuer, keys, state):
    """At reset an expert that starts in any state equals the demonstrator."""

    @jax.jit
    @jax.vmap
    def first(key, state):
        ours = rescuer.act(rescuer.resume(key, state), state)[0]
        return ours, agent.act(agent.init(key, state), state)[0]

    ours, theirs = first(keys, state)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=5e-6), ours, theirs)


def test_the_needle_is_that_of_the_model():
    m = scene.compose(scene.name("needle_pick"))
    middles, tangents = needle.segments()
    for k in range(needle.SEGMENTS):
        pair = [m.geom(f"wire{k}{side}") for side in "ab"]
        np.testing.assert_allclose(np.mean([g.pos for g in pair], 0), middles[k], atol=1e-6)
        R = np.zeros(9)

        mujoco.mju_quat2Mat(R, pair[0].quat)
        assert abs(R.reshape(3, 3)[:, 2] @ tangents[k]) > 1 - 1e-6
    assert 0.065e-3 < m.body("needle").mass[0] < 0.075e-3  # kg, of steel
