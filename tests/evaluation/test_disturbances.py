"""One thing is wrong, by as much as the level says, and nothing else."""

import zlib

import jax
import jax.numpy as jnp
import mistakes
import mujoco
import numpy as np
import pytest
import stubs

from starjax.core.types import Command, Pose
from starjax.evaluation import disturbances
from starjax.evaluation.disturbances import DISTURBANCES, base, images, timing, trocars
from starjax.evaluation.disturbances.base import with_disturbances, with_random_levels
from starjax.sim import env as envs
from starjax.sim.state import EnvParams

KEY = jax.random.key(3)
PARAMS = EnvParams(jax.tree.map(lambda x: x[0], stubs.trocars(4, arms=2)))
CAMERAS = Pose(jnp.stack([jnp.eye(3)] * 2), jnp.array([[0.1, 0.2, 0.3], [0.0, -0.1, 0.4]]))
KINDS = {name: DISTURBANCES.get(name) for name in DISTURBANCES.built_in}
PHYSICAL = ("weak_servos", "friction", "mass")  # they need a model
NAMES = (
    "observation_delay",
    "observation_dropout",
    *PHYSICAL,
)  # states that are kept have a model of their own too
OTHERS = [name for name in KINDS if name not in PHYSICAL]


@pytest.fixture
def env():
    made = stubs.make_env("image", unlucky=0.0, arms=2)

    def reset(key, params):
        return made.reset(key, params).replace(cameras=CAMERAS)

    return made._replace(reset=reset)


def at(**levels):
    return PARAMS._replace(levels=levels)


def held(state):
    return Command(state.pose, state.gripper)


def same(a, b):
    return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b)))


@pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)
def test_levels_begin_with_none_and_rise_as_far_as_there_are_any(kind):
    assert kind.levels[0] == 0.0 and kind.levels[-1] <= kind.max_level
    assert list(kind.levels) == sorted(set(kind.levels))


@pytest.mark.parametrize("name", OTHERS)
def test_episodes_begin_as_without_it_and_are_their_key_s(env, name):
    wrong, highest = with_disturbances(env, [name]), at(**{name: KINDS[name].levels[-1]})
    usual, first, again = env.reset(KEY, PARAMS), *(wrong.reset(KEY, highest) for _ in range(2))
    assert same(first.layout, usual.layout)
    assert same(first.trocar, usual.trocar) and same(first.pose, usual.pose)
    assert same(wrong.observe(first), wrong.observe(again))


@pytest.mark.parametrize("name", OTHERS)
def test_at_level_0_and_once_it_is_over_nothing_is_wrong(env, name):
    wrong = with_disturbances(env, [name])
    usual, state = env.reset(KEY, PARAMS), wrong.reset(KEY, at(**{name: 0.0}))
    to = Command(Pose(usual.pose.R, usual.pose.p + 0.01), usual.gripper)
    for _ in range(3):
        usual, state = env.step(usual, to), wrong.step(state, to)
        np.testing.assert_allclose(state.pose.p, usual.pose.p)
        assert same(wrong.observe(state), env.observe(usual))
    over = state.replace(done=jnp.ones((), bool))
    after = wrong.step(over, held(over))
    assert same(after.pose, over.pose) and same(after.trocar, over.trocar)


def test_several_are_wrong_at_once_each_at_its_level_and_one_program_has_all_levels(env):
    wrong = with_disturbances(
        env, ["observation_delay", "darkness", "action_delay", "observation_dropout"]
    )
    start, step = jax.jit(wrong.reset), jax.jit(wrong.step)
    for steps in (1, 4):
        state = start(
            KEY,
            at(observation_delay=0.0, darkness=0.5, action_delay=steps, observation_dropout=0.0),
        )
        first, to = state.pose.p, Command(Pose(state.pose.R, state.pose.p + 0.1), state.gripper)
        for _ in range(steps):
            state = step(state, to)
            np.testing.assert_array_equal(state.pose.p, first)
        assert np.all(step(state, to).pose.p > first)
        bright = env.observe(state).images["camera"].astype(float)
        np.testing.assert_allclose(wrong.observe(state).images["camera"], bright / 2, atol=0.51)
    assert start._cache_size() == step._cache_size() == 1


def test_with_all_of_them_only_what_has_a_level_is_wrong(env):
    together = with_disturbances(env, OTHERS)
    start, step_all = jax.jit(together.reset), jax.jit(together.step)
    for only in ([], ["breathing"], ["breathing_tracked"]):
        wrong = dict.fromkeys(only, 5.0)
        alone = with_disturbances(env, only)
        one = alone.reset(KEY, at(**wrong))
        all_of_them = start(KEY, at(**(dict.fromkeys(OTHERS, 0.0) | wrong)))
        for _ in range(6):
            to = Command(Pose(one.pose.R, one.pose.p + 0.01), one.gripper)
            one, all_of_them = alone.step(one, to), step_all(all_of_them, to)
        for name in ("pose", "gripper", "step", "trocar", "measured_trocar", "cameras"):
            pairs = zip(*(jax.tree.leaves(getattr(s, name)) for s in (one, all_of_them)))
            for x, y in pairs:
                np.testing.assert_allclose(x, y, atol=1e-6)
        assert same(together.observe(all_of_them).images, alone.observe(one).images)
    assert step_all._cache_size() == 1


@pytest.mark.parametrize("level", [1.0, 10.0])
def test_trocars_are_told_so_far_from_the_truth(env, level):
    wrong = with_disturbances(env, ["trocar_offset"])
    states = [wrong.reset(jax.random.key(k), at(trocar_offset=level)) for k in (0, 1)]
    for state in states:
        apart = state.measured_trocar.p_world_trocar - state.trocar.p_world_trocar
        np.testing.assert_allclose(jnp.linalg.norm(apart, axis=-1), 1e-3 * level, rtol=1e-2)
    assert not same(states[0].measured_trocar, states[1].measured_trocar)


@pytest.mark.parametrize("name", ["breathing", "breathing_tracked"])
def test_trocars_rise_and_fall_with_the_breath(env, name):
    wrong = with_disturbances(env, [name])
    state = first = wrong.reset(KEY, at(**{name: 5.0}))
    step, rises, said = jax.jit(wrong.step), [], []
    for _ in range(round(env.control_hz / trocars.BREATH_HZ)):
        state = step(state, held(state))
        apart = state.trocar.p_world_trocar - first.trocar.p_world_trocar
        np.testing.assert_allclose(apart[:, :2], 0.0, atol=1e-6)
        rises.append(float(apart[0, 2]))
        said.append(
            float(
                (state.measured_trocar.p_world_trocar - first.measured_trocar.p_world_trocar)[0, 2]
            )
        )
    np.testing.assert_allclose([max(rises), rises[-1]], [5e-3, 0.0], atol=1e-5)
    late = round(trocars.LATENCY_S * env.control_hz)
    expected = np.zeros(late).tolist() + rises[:-late] if name == "breathing_tracked" else 0.0
    np.testing.assert_allclose(said, expected, atol=1e-6)


def test_cameras_are_moved_and_turned(env):
    state = with_disturbances(env, ["camera"]).reset(KEY, at(camera=4.0))
    apart = jnp.linalg.norm(state.cameras.p - CAMERAS.p, axis=-1)
    np.testing.assert_allclose(apart, 4e-3, rtol=1e-3)
    cos = (jnp.trace(state.cameras.R, axis1=1, axis2=2) - 1) / 2
    np.testing.assert_allclose(np.rad2deg(np.arccos(cos)), 2.0, rtol=1e-2)


def looked(env, name, level, image, key=KEY, step=0):
    """What is seen of `image` `[h, w, 3]`."""
    plain = env._replace(
        observe=lambda state: env.observe(state)._replace(images={"camera": jnp.asarray(image)})
    )
    wrong = with_disturbances(plain, [name])
    state = wrong.reset(key, at(**{name: level}))
    return np.array(wrong.observe(state.replace(step=state.step + step)).images["camera"], float)


@pytest.mark.parametrize(
    ("name", "level", "wanted"),
    [
        ("darkness", 0.4, lambda x: 0.6 * x),
        ("smoke", 0.25, lambda x: 0.75 * x + 0.25 * 255),
    ],
)
def test_images_are_changed_as_is_said(env, name, level, wanted):
    image = np.random.default_rng(0).integers(0, 256, (6, 6, 3)).astype(np.uint8)
    np.testing.assert_allclose(
        looked(env, name, level, image), wanted(image.astype(float)), atol=0.51
    )


def test_a_lens_colours_every_pixel_alike_and_each_episode_otherwise(env):
    grey = np.full((6, 6, 3), 100, np.uint8)
    found = [looked(env, "tint", 0.2, grey, jax.random.key(k)) for k in range(4)]
    for seen in found:
        assert np.ptp(seen, axis=(0, 1)).max() == 0
        np.testing.assert_allclose(np.abs(seen[0, 0] / 100 - 1).max(), 0.2, atol=0.005)
    assert len({tuple(seen[0, 0]) for seen in found}) == 4


@pytest.mark.parametrize("level", [0.05, 0.2])
def test_blood_hides_so_much_of_the_picture_and_leaves_the_rest(env, level):
    green = np.full((64, 64, 3), (0, 200, 0), np.uint8)
    found = np.stack([looked(env, "blood", level, green, jax.random.key(k)) for k in range(30)])
    is_hidden = (found != green).any(-1)
    np.testing.assert_allclose(is_hidden.mean(), level, rtol=0.1)
    colours = np.unique(np.round(found[is_hidden]), axis=0)
    wanted = np.round(255 * np.array([images.BLOOD_RGB, images.SHINE_RGB]))
    np.testing.assert_array_equal(colours, wanted)


def test_blurred_pixels_are_means_of_those_around_that_there_are(env):
    image = np.random.default_rng(0).integers(0, 256, (6, 6, 3)).astype(np.uint8)
    found = looked(env, "blur", 1.0, image)
    for where, near in (((1, 1), np.s_[:3, :3]), ((0, 0), np.s_[:2, :2]), ((5, 3), np.s_[4:, 2:5])):
        np.testing.assert_allclose(found[where], image[near].mean((0, 1)), atol=0.51)


def test_noise_is_as_strong_as_said_and_new_at_every_step(env):
    grey = np.full((100, 100, 3), 128, np.uint8)
    now, later = (looked(env, "noise", 0.05, grey, step=step) for step in (0, 1))
    other = looked(env, "noise", 0.05, grey, jax.random.key(9))
    np.testing.assert_allclose(now.std() / 255, 0.05, rtol=0.05)
    for image in (later, other):
        assert abs(np.corrcoef(now.ravel(), image.ravel())[0, 1]) < 0.05


def went(env, name, level, steps=40):
    """Tips that are seen and tips that are, of an episode in which arms move: `[steps, 3]` m."""
    wrong = with_disturbances(env, [name])
    step, state = jax.jit(wrong.step), wrong.reset(KEY, at(**{name: level}))
    seen, true = [], []
    for _ in range(steps):
        seen.append(wrong.observe(state).pose.p[0])
        true.append(state.pose.p[0])
        state = step(state, Command(Pose(state.pose.R, state.pose.p + 0.001), state.gripper))
    return np.array(seen), np.array(true)


@pytest.mark.parametrize("steps", range(1, timing.MAX_DELAY + 1))
def test_what_is_seen_is_so_many_steps_old(env, steps):
    seen, true = went(env, "observation_delay", float(steps), steps=8)
    np.testing.assert_array_equal(seen[steps:], true[:-steps])
    np.testing.assert_array_equal(seen[:steps], np.tile(true[0], (steps, 1)))


def test_late_commands_of_a_wrist_are_late_with_its_angles(env):
    """Straight ones too, whose command has no angles."""
    state = env.reset(KEY, EnvParams(stubs.trocars(0), levels=None))
    state = state.replace(wrist=jnp.full((1, 2), 0.1))
    executed = []
    fake = env._replace(step=lambda state, command: executed.append(command) or state)
    _, memory = timing._hold_pose(fake, base.DisturbanceState(jnp.float32(2), KEY), state)
    for wrist in (jnp.full((1, 2), 0.5), None, None):
        command = Command(state.pose, state.gripper, wrist)
        late = base.DisturbanceState(jnp.float32(2), KEY, memory)
        _, memory = timing._execute_past(fake, late, state, command)
    np.testing.assert_allclose([c.wrist[0, 0] for c in executed], [0.1, 0.1, 0.5])


def test_lost_observations_are_replaced_by_the_last_one_that_came(env):
    seen, true = went(env, "observation_dropout", 0.3, steps=200)
    is_new = np.all(seen == true, -1)
    np.testing.assert_allclose(1 - is_new[1:].mean(), 0.3, atol=0.08)
    for t in np.flatnonzero(~is_new):
        np.testing.assert_array_equal(seen[t], seen[t - 1])


def test_policies_of_states_meet_what_is_no_image_s():
    env = stubs.make_env("state")
    params = EnvParams(jax.tree.map(lambda x: x[0], stubs.trocars(4)), levels={"smoke": 0.5})
    wrong = with_disturbances(env, ["smoke"])
    state = wrong.reset(KEY, params)
    assert same(wrong.observe(state), env.observe(state))


def test_demonstrations_meet_levels_up_to_the_highest(env):
    most = {"smoke": 0.4, "tint": 0.2}
    wrong = with_random_levels(env, most)
    drawn = [
        [float(now.level) for now in wrong.reset(jax.random.key(k), PARAMS).wrapper_state.values()]
        for k in range(60)
    ]
    high, low = np.max(drawn, 0), np.min(drawn, 0)
    for i, level in enumerate(most.values()):
        assert 0 <= low[i] < 0.1 * level and 0.9 * level < high[i] <= level
    assert abs(np.corrcoef(np.array(drawn).T)[0, 1]) < 0.3


def test_texts_other_than_names_seed_some_draws():
    assert {kind.stream: name for name, kind in KINDS.items() if kind.stream} == {
        "trocar_told": "trocar_offset",
        "breathing_late": "breathing_tracked",
        "late_view": "observation_delay",
        "late_commands": "action_delay",
        "dropped": "observation_dropout",
        "servos": "weak_servos",
    }
    key = base.start("weak_servos", 0.5, KEY).key
    assert key == jax.random.fold_in(KEY, zlib.crc32(b"servos"))


@pytest.mark.parametrize(
    "written", ["rain=1", "smoke", "smoke=much", "smoke=0", "smoke=nan", "smoke=1 smoke=2"]
)
def test_levels_that_are_none_are_refused(written):
    with mistakes.of("demos.randomise"):
        disturbances.parse_levels("demos.randomise", written.split())
    with mistakes.of("levels", 5.0):
        base.check_levels("levels", "observation_delay", [1.0, 5.0])


@pytest.fixture(scope="module")
def reach():
    return envs.make("reach", observation="state")


@pytest.fixture(scope="module")
def moved(reach):
    """`levels -> state after a motion of 8 control steps`; one program."""
    wrong = with_disturbances(reach, NAMES)
    params = EnvParams(jax.tree.map(lambda x: jnp.asarray(x)[0], reach.task.trocars))

    @jax.jit
    def run(levels):
        first = wrong.reset(KEY, params._replace(levels=levels))
        to = Command(Pose(first.pose.R, first.pose.p + 0.02), first.gripper)
        return jax.lax.fori_loop(0, 8, lambda _, state: wrong.step(state, to), first)

    return lambda **levels: run({**dict.fromkeys(NAMES, 0.0), **levels})


@pytest.mark.slow
def test_servos_of_arms_are_weaker_by_a_share_and_move_otherwise(reach, moved):
    usual, weak, weakest = (moved(weak_servos=level) for level in (0.0, 0.5, 0.9))
    m, of_arms = reach.scene.mj_model, reach.scene.arms[0].ctrl
    for name in ("actuator_gainprm", "actuator_biasprm"):
        wanted = getattr(m, name).copy()
        wanted[of_arms] *= 0.5
        np.testing.assert_allclose(weak.model[name], wanted, rtol=1e-6)
    q = [state.physics.qpos[reach.scene.arms[0].q] for state in (usual, weak, weakest)]
    apart = [float(jnp.max(jnp.abs(other - q[0]))) for other in q[1:]]
    assert 1e-5 < 2 * apart[0] < apart[1]


@pytest.mark.slow
def test_friction_of_all_geoms_is_less_by_a_share(reach, moved):
    usual = reach.scene.mj_model.geom_friction
    np.testing.assert_allclose(moved(friction=0.25).model["geom_friction"], 0.75 * usual, rtol=1e-6)


def test_objects_weigh_more_or_less_as_mujoco_itself_would_have_them():
    scene = envs.scenes.load(envs.scenes.name("needle_pick"))
    env = stubs.make_env()._replace(scene=scene)
    wrong = with_disturbances(env, ["mass"])
    params = EnvParams(jax.tree.map(lambda x: x[0], stubs.trocars(4)), levels={"mass": 0.5})
    found = {}
    for k in range(4):
        model = wrong.reset(jax.random.key(k), params).model
        m = scene.mj_model.__copy__()
        objects = np.unique(m.geom_bodyid[scene.graspable])
        times = float(model["body_mass"][objects[0]] / m.body_mass[objects[0]])
        m.body_mass[objects] *= times
        m.body_inertia[objects] *= times
        mujoco.mj_setConst(m, mujoco.MjData(m))
        for name in ("body_mass", "body_inertia"):
            np.testing.assert_allclose(model[name], getattr(m, name), rtol=1e-5)
        ours, theirs = model["body_invweight0"][objects, 0], m.body_invweight0[objects, 0]
        np.testing.assert_allclose(ours, theirs, rtol=1e-3)
        found[round(times, 3)] = True
    assert sorted(found) == [0.5, 1.5]
