"""Every method of Table II: the trained parameters and the guarantees of samples."""

import dataclasses
import functools

import chex
import fakes
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax import rcm
from starjax.core import config
from starjax.core.methods import METHODS
from starjax.data import normalizer, windows
from starjax.policies import execution, features, generator, hierarchical
from starjax.policies import policy as policies
from starjax.policies.models import encoders, roll_net
from starjax.policies.models.kernels import packed_params

STRAIGHT = [name for name, row in METHODS.items() if not normalizer.has_wrist(row)]
TRAIN = config.TrainConfig(state_noise=0.0)
SEEN = features.select_sensors(fakes.TASK)
B = 4


def jit(fn):
    # these programs run once: compiling them badly is fast
    return jax.jit(fn, compiler_options={"xla_backend_optimization_level": 0})


@pytest.fixture(scope="module")
def dataset():
    return fakes.dataset(seed=0, demos=4, length=20, image_size=fakes.TINY.image_size)


@jax.jit
def gather(dataset, steps):
    return windows.gather(dataset, steps, 2, 16)


class Made:
    """A policy with random weights, and compiled functions of it."""

    def __init__(self, name, dataset, observation="state", **changed):
        self.method, self.observation, self.dataset = METHODS[name], observation, dataset
        settings = dataclasses.replace(fakes.TINY, observation=observation, **changed)
        self.settings = settings
        self.policy = policies.make(self.method, settings, fakes.TASK, TRAIN)
        self.stats = normalizer.fit(self.method, fakes.TASK, dataset, np.arange(80))
        self.params = fakes.params(self.policy)
        self.batch = gather(dataset, jnp.array([3, 25, 70, 44]))
        self.sample = jit(self.policy.sample)
        self.gradient = jit(jax.value_and_grad(self.loss, has_aux=True))

    def loss(self, params, stats, key, batch):
        return self.policy.loss(params, self.policy.prepare(stats, key, batch))

    @property
    def loss_arguments(self):
        return self.params, self.stats, jax.random.key(0), self.batch

    def commands(self, keys=None, trocar=None, params=None):
        return self.sample(
            self.params if params is None else params,
            self.stats,
            jax.random.split(jax.random.key(1), B) if keys is None else keys,
            self.batch.observation,
            self.batch.trocar if trocar is None else trocar,
        )


@pytest.fixture(scope="module")
def made(dataset):
    return functools.cache(lambda name, observation="state": Made(name, dataset, observation))


@pytest.mark.parametrize(
    ("name", "observation"), [("dp_ee", "state"), ("stardiff", "state"), ("stardiff", "image")]
)
def test_every_parameter_learns(made, name, observation):
    it = made(name, observation)
    params = it.params
    if (name, observation) != ("stardiff", "state"):  # it has no network that the others lack
        params = jit(it.policy.init)(jax.random.key(0))
        chex.assert_trees_all_equal_shapes_and_dtypes(params, it.params)
    (loss, _), gradient = it.gradient(params, *it.loss_arguments[1:])
    assert np.isfinite(loss) and 0.2 < loss < 5.0
    flat = jax.tree_util.tree_flatten_with_path(gradient)[0]
    for path, g in flat:
        assert np.isfinite(g).all(), path
        # the roll network starts at zero: only its last layer feels the first step
        if "roll" not in jax.tree_util.keystr(path):
            assert np.abs(g).max() > 0, path


@pytest.mark.parametrize("name", STRAIGHT)
def test_every_method_samples(made, name):
    it = made(name)
    keys = jax.random.split(jax.random.key(1), B)
    given = it.params, it.stats, keys, it.batch.observation, it.batch.trocar
    command = jax.eval_shape(it.policy.sample, *given)
    assert command.pose.R.shape == (B, 16, 1, 3, 3)
    assert command.gripper.shape == (B, 16, 1)


@pytest.mark.parametrize("name", ["dp_ee", "dp_ee_proj", "dp_rcm4", "stardiff", "stardiff_told"])
def test_samples_are_finite_and_respect_the_manifold(made, name):
    it = made(name)
    command = it.commands()
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(command))
    assert np.abs(command.gripper).max() <= 1.0
    assert off_the_manifold(it, command) == (name == "dp_ee")


def off_the_manifold(it, command):
    port = it.batch.trocar.p_world_trocar[:, None]
    return np.asarray(rcm.rcm_error(command.pose, port)).max() > 1e-6


@pytest.mark.parametrize("name", ["stardiff", "dp_ee", "dp_ee_proj"])
def test_samples_are_finite_with_broken_weights(made, name):
    it = made(name)
    command = it.commands(params=jax.tree.map(lambda x: x * jnp.nan, it.params))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(command))


@pytest.mark.parametrize("hierarchical", [False, True])
def test_samples_reach_as_far_as_the_normaliser_says(dataset, hierarchical, monkeypatch):
    """A position that counts from the port may be farther than any demonstration's was."""
    row = METHODS["stardiff" if hierarchical else "dp_rcm2"]._replace(action_space="rcm2")
    monkeypatch.setitem(METHODS.registry.built_in, "row", row)
    it = Made("row", dataset)
    part = rcm.ACTION_SPACES["rcm2"].slices["p"]
    lifted = it.stats.replace(action=it.stats.action.replace(reach=it.stats.action.reach + 3.0))
    arguments = jax.random.split(jax.random.key(1), B), it.batch.observation, it.batch.trocar

    def scaled(stats):
        pose = it.sample(it.params, stats, *arguments).pose
        told = features.per_step(it.batch.trocar)
        vector = normalizer.encode("rcm2", pose, jnp.zeros((B, 16, 1)), told)
        return stats.action.normalize(vector)[..., part]

    low, high = np.asarray(it.stats.action.reach)[:, part]
    assert (scaled(it.stats) > low - 1e-3).all() and (scaled(it.stats) < high + 1e-3).all()
    assert (scaled(lifted) > low + 3.0 - 1e-3).all()


@pytest.mark.parametrize("name", ["stardiff", "dp_rcm4"])
def test_a_sample_depends_on_its_own_key_alone(made, name):
    it = made(name)
    keys = jax.random.split(jax.random.key(1), B)
    first = it.commands(keys)
    second = it.commands(keys.at[1].set(jax.random.key(99)))
    same = np.asarray(jnp.abs(first.pose.p - second.pose.p).max((1, 2, 3)))
    np.testing.assert_array_equal(same == 0.0, [True, False, True, True])


def test_hierarchical_positions_do_not_know_the_trocar(made):
    it = made("stardiff")
    other = jax.tree.map(lambda x: jnp.roll(x, 1), it.batch.trocar)
    here, there = it.commands(), it.commands(trocar=other)
    np.testing.assert_allclose(here.pose.p, there.pose.p, atol=1e-6)
    np.testing.assert_allclose(here.gripper, there.gripper, atol=1e-6)
    assert np.abs(here.pose.R - there.pose.R).max() > 1e-3


@pytest.mark.parametrize("name", ["dp_rcm4", "stardiff_told"])
def test_trocar_conditioned_positions_do_know_it(made, name):
    it = made(name)
    other = jax.tree.map(lambda x: jnp.roll(x, 1), it.batch.trocar)
    assert np.abs(it.commands().pose.p - it.commands(trocar=other).pose.p).max() > 1e-5


def test_projection_keeps_the_tip(made):
    free, projected = made("dp_ee").commands(), made("dp_ee_proj").commands()
    np.testing.assert_allclose(free.pose.p, projected.pose.p, atol=1e-6)
    np.testing.assert_allclose(free.gripper, projected.gripper, atol=1e-5)


@pytest.mark.parametrize("name", ["stardiff", "dp_rcm1"])
def test_images_work(made, name):
    it = made(name, "image")
    other = it.batch.observation._replace(
        images={"camera": jnp.zeros((B, 2, 32, 32, 3), jnp.uint8)}
    )
    command = it.commands()
    assert np.isfinite(command.pose.p).all()
    keys = jax.random.split(jax.random.key(1), B)
    blind = it.sample(it.params, it.stats, keys, other, it.batch.trocar)
    assert np.abs(command.pose.p - blind.pose.p).max() > 1e-5


def test_a_missing_observation_is_named(made, dataset):
    it = made("stardiff")
    blind = it.batch.replace(observation=it.batch.observation._replace(state=None))
    with pytest.raises(ValueError, match=r"observation.state: expected"):
        jax.eval_shape(it.policy.prepare, it.stats, jax.random.key(0), blind)


@pytest.mark.parametrize(
    ("name", "sees", "wider"),
    [
        ("dp_ee", "always", 1),
        ("dp_rcm4", "never", -1),
        ("stardiff", "always", 1),
        ("stardiff_told", "never", -1),
    ],
)
def test_a_method_may_be_given_the_trocar_or_not(made, dataset, name, sees, wider):
    changed = Made(name, dataset, sees_trocar=sees)
    observation, trocar = changed.batch.observation, changed.batch.trocar
    keys = jax.random.split(jax.random.key(1), B)
    jax.eval_shape(changed.gradient, *changed.loss_arguments)
    jax.eval_shape(changed.sample, changed.params, changed.stats, keys, observation, trocar)
    widths = []
    for it in (changed, made(name)):
        widths.append(it.params["learner"]["unet"]["params"]["film_cond"].shape[0])
    assert widths[0] - widths[1] == wider * features.TROCAR_FEATURES


def test_only_relative_actions_have_a_trocar_frame_to_turn():
    fixed = dataclasses.replace(fakes.TINY, trocar_yaw="fixed")
    spaces = {name: policies.ablated(row, fixed).action_space for name, row in METHODS.items()}
    changed = {name: space for name, space in spaces.items() if space != METHODS[name].action_space}
    assert changed == {"dp_rcm1": "rcm1_fixed_yaw", "dp_rcm2": "rcm2_fixed_yaw"}


def turned(observation):
    pose = observation.pose
    half_a_turn = np.diag([-1.0, -1.0, 1.0]).astype(np.float32)
    return observation._replace(pose=pose._replace(R=pose.R @ half_a_turn))


def elsewhere(observation):
    return observation._replace(state=observation.state + 0.05)


def moved(trocar):
    wider = trocar.trocar._replace(radius=trocar.trocar.radius + 0.01)
    return rcm.trocar_frame(wider, fakes.P_WORLD_REF)


@pytest.mark.parametrize(
    ("changed", "matters"),
    [
        ({}, (True, True, False)),
        ({"roll_history": False}, (False, True, False)),
        # measured rolls are relative to the trocar's frame
        ({"roll_history": False, "roll_trocar": False}, (False, False, False)),
        ({"roll_observation": True}, (True, True, True)),
    ],
)
def test_what_the_roll_network_reads(made, dataset, changed, matters):
    it = Made("stardiff", dataset, **changed) if changed else made("stardiff")
    params = jax.tree.map(lambda leaf: leaf + 0.01, it.params)
    # the same positions for any observation
    params["learner"] = jax.tree.map(jnp.zeros_like, params["learner"])
    keys = jax.random.split(jax.random.key(0), B)

    def roll(observation, trocar):
        command = it.sample(params, it.stats, keys, observation, trocar)
        return rcm.ACTION_SPACES["rcm4"].encode(command.pose, features.per_step(trocar))[..., 0]

    seen, trocar = it.batch.observation, it.batch.trocar
    before = roll(seen, trocar)
    after = (roll(turned(seen), trocar), roll(seen, moved(trocar)), roll(elsewhere(seen), trocar))
    assert tuple(float(jnp.abs(x - before).max()) > 1e-4 for x in after) == matters


def test_what_both_networks_read_is_encoded_once(dataset, monkeypatch):
    calls, encode = [], encoders.StateEncoder.apply
    monkeypatch.setattr(
        encoders.StateEncoder, "apply", lambda *args: calls.append(1) or encode(*args)
    )
    it = Made("stardiff", dataset, roll_observation=True)
    calls.clear()
    jax.eval_shape(it.loss, *it.loss_arguments)
    assert len(calls) == 1


def test_hierarchy_needs_a_roll():
    method = METHODS["dp_rcm1"]._replace(hierarchical=True)
    with pytest.raises(ValueError, match="expected one of turns and position"):
        policies.make(method, fakes.TINY, fakes.TASK, TRAIN)


@pytest.mark.parametrize("name", STRAIGHT)
def test_demonstrated_actions_become_the_demonstrated_commands(made, name, dataset):
    it = made(name)
    action = features.encode_commands(it.stats, it.method.action_space, it.batch)
    command = execution.command(it.method, it.stats, action, it.batch.trocar)
    np.testing.assert_allclose(command.pose.p, it.batch.command.pose.p, atol=2e-6)
    np.testing.assert_allclose(command.pose.R, it.batch.command.pose.R, atol=2e-5)
    np.testing.assert_allclose(command.gripper, it.batch.command.gripper, atol=1e-6)


@pytest.mark.parametrize("name", STRAIGHT)
def test_no_action_breaks_a_command(made, name):
    it = made(name)
    dim = it.stats.action.low.shape[0]
    bad = jnp.array([np.nan, np.inf, -np.inf, 1e38])[:, None, None]
    action = jnp.where(jnp.eye(16, dim) > 0, bad, 0.0)
    command = execution.command(it.method, it.stats, action, it.batch.trocar)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(command))
    assert np.abs(command.gripper).max() <= 1.0
    assert off_the_manifold(it, command) == (name == "dp_ee")


def test_trocar_features():
    trocar = rcm.Trocar(jnp.float32(0.05), jnp.float32(np.pi / 2), jnp.float32(np.pi))
    found = features.trocar_features(trocar)
    np.testing.assert_allclose(found, [1, 0, -1, 0, -1, 0, 0], atol=1e-6)


def test_noise_is_in_normalised_units(made):
    it = made("stardiff")
    noisy = dataclasses.replace(TRAIN, state_noise=0.5)
    clean = jnp.zeros((B, 2, 4))
    seen = (SEEN, it.stats)
    key = jax.random.key(0)
    drawn = features.training_inputs(fakes.TINY, noisy, *seen, key, it.batch.observation, clean)
    exact = features.inference_inputs(fakes.TINY, *seen, it.batch.observation, clean)
    spread = float(jnp.std(drawn.history - exact.history))
    assert 0.4 < spread < 0.6


def test_state_features_tell_block_and_target_from_the_tip(made):
    it = made("stardiff")
    tip = it.batch.observation.pose.p[:, :, 0]
    quarter_turn = jnp.array([0.0, 1.0, 0.0, -1.0, 0.0, 0.0])
    state = jnp.concatenate(
        [
            tip + jnp.array([0.03, 0.0, 0.0]),
            jnp.broadcast_to(quarter_turn, (B, 2, 6)),
            tip - jnp.array([0.0, 0.0, 0.06]),
        ],
        axis=-1,
    )
    observation = it.batch.observation._replace(state=state)
    inputs = features.inference_inputs(
        fakes.TINY, SEEN, it.stats, observation, jnp.zeros((B, 2, 4))
    )
    expected = np.broadcast_to([1, 0, 0, 0, -1, 0, 0, 0, -2], (B, 2, 9))
    np.testing.assert_allclose(inputs.history[..., -9:], expected, atol=1e-5)


def test_large_matrices_are_rounded_once_to_what_sample_rounds_them_to(dataset):
    it = Made("stardiff", dataset, "image", dtype="bfloat16")
    rounded = it.policy.prepare_for_inference(it.params)
    jax.tree.map(np.testing.assert_array_equal, it.commands(), it.commands(params=rounded))
    kinds = {
        jax.tree_util.keystr(path): leaf.dtype
        for path, leaf in jax.tree_util.tree_leaves_with_path(rounded)
    }
    exact = {name for name, kind in kinds.items() if kind == jnp.float32}
    assert any("film_cond" in name for name in kinds.keys() - exact)
    assert not any("'unet'" in name and "'kernel'" in name for name in exact)
    assert all("'kernel'" in n or "film_" in n for n in kinds.keys() - exact)


@pytest.mark.parametrize("name", ["stardiff", "dp_rcm1"])
def test_a_gpu_is_handed_fewer_arrays_that_say_the_same(made, name, monkeypatch):
    it = made(name, "image")
    params, wanted = it.params, it.commands()
    chex.assert_trees_all_equal(
        it.policy.prepare_for_inference(params), params
    )  # as a CPU is handed them
    sampling_unet = pytest.importorskip("starjax.addons.decisions.sampling_unet")
    monkeypatch.setattr(sampling_unet, "pays", lambda: True)
    monkeypatch.setattr(packed_params, "PLATFORMS", {"cpu"})
    ready = it.policy.prepare_for_inference(params)
    assert len(jax.tree.leaves(ready)) < 0.6 * len(jax.tree.leaves(params))
    assert "second" in str(jax.tree.structure(ready))
    chex.assert_trees_all_close(it.commands(params=ready), wanted, atol=2e-5)


def prepared(it, *trainings):
    """What 64 windows are learned as, under each of other settings of training; the windows."""
    made = [
        policies.make(it.method, it.settings, fakes.TASK, dataclasses.replace(TRAIN, **changed))
        for changed in trainings or ({},)
    ]
    batch = gather(it.dataset, jnp.arange(64))
    prepare = jit(lambda *given: [policy.prepare(*given) for policy in made])
    return *prepare(it.stats, jax.random.key(0), batch), batch


def test_the_losses_are_weighed(made):
    it = made("stardiff")
    (loss, parts), _ = it.gradient(*it.loss_arguments)
    weight = fakes.TINY.roll_loss_weight
    expected = parts["position_loss"] + weight * parts["roll_loss"]
    assert float(loss) == pytest.approx(float(expected), rel=1e-5)
    assert parts["roll_loss"] > 0.01


def test_the_roll_network_learns_from_inexact_inputs_what_is_exact(made):
    it = made("stardiff")
    given, batch = prepared(it)
    given = given.lesson
    exact = jit(lambda x: features.encode_commands(it.stats, "rcm4", x))(batch)
    seen = jit(lambda x: features.encode_proprioception(it.stats, "rcm4", x.observation, x.trocar))(
        batch
    )
    p = np.ravel(given.path[:, :, 0] - exact[..., 1:4])
    roll = np.ravel(given.history[:, :, 0] - seen[..., :1])
    assert p.std() == pytest.approx(hierarchical.POSITION_NOISE, rel=0.1)
    assert roll.std() == pytest.approx(hierarchical.ROLL_NOISE, rel=0.2)
    assert abs(np.corrcoef(p[: roll.size], roll)[0, 1]) < 0.4
    np.testing.assert_allclose(given.target[:, :, 0], exact[..., :1], atol=1e-6)


@pytest.mark.parametrize("name", ["stardiff", "dp_rcm4"])
def test_training_adds_noise_to_what_is_measured(made, name):
    noisy, exact, _ = prepared(made(name), {"state_noise": 0.5}, {"state_noise": 0.0})
    assert float(jnp.std(noisy.inputs.history - exact.inputs.history)) == pytest.approx(
        0.5, rel=0.1
    )


@pytest.mark.parametrize("name", ["stardiff", "dp_rcm1"])
def test_training_changes_pictures_and_is_told_where_they_are_cropped(made, name):
    it = made(name, "image")
    exact = {"jitter": 0.0, "image_noise": 0.0}
    inputs, jittered, noisy = (
        x.inputs
        for x in prepared(it, exact, {**exact, "jitter": 0.5}, {**exact, "image_noise": 0.05})[:3]
    )
    assert inputs.images.shape == (64, 2, 1, 29, 29, 3)
    assert len(np.unique(np.asarray(inputs.offset).reshape(-1, 2), axis=0)) == 16
    assert np.abs(jittered.images - inputs.images).max() > 0.5
    assert np.abs(noisy.images - inputs.images).max() > 0.1
    width = inputs.history.shape[-1]
    networks = generator.make(it.method, it.settings, SEEN, width)
    observe = jit(lambda *seen: networks.observe(*seen, jnp.zeros((B, 0))).vision)
    first = jax.tree.map(lambda x: x[:B], inputs)
    here, there = (
        observe(it.params, x) for x in (first, first._replace(offset=first.offset + 4.0))
    )
    assert np.abs(here - there).max() > 1e-3


def test_rolls_stay_in_the_demonstrated_range(made):
    it = made("stardiff")
    out = it.params["roll"]["params"]["out"]
    far = {**out, "bias": jnp.full_like(out["bias"], 9.0)}
    params = {**it.params, "roll": {"params": {**it.params["roll"]["params"], "out": far}}}
    roll = rcm.roll_of(it.commands(params=params).pose.R)
    np.testing.assert_allclose(roll, it.stats.action.high[0], atol=1e-5)


def test_what_is_held_is_not_dropped(made):
    it = made("stardiff")
    action = jnp.ones((B, 16, 5)).at[:, 3, -1].set(jnp.nan).at[:, 5, 0].set(jnp.nan)
    command = execution.command(it.method, it.stats, action, it.batch.trocar)
    np.testing.assert_array_equal(command.gripper[:, [3, 5]], -1.0)
    np.testing.assert_array_equal(command.gripper[:, 4], 1.0)


def test_features_of_any_trocar():
    found = features.trocar_features(rcm.Trocar(0.02, 1.2, -0.7))
    cos, sin = np.cos([1.2, -0.7]), np.sin([1.2, -0.7])
    shift = 0.4 * np.array([sin[0] * cos[1], sin[0] * sin[1], cos[0]])
    np.testing.assert_allclose(found, [0.4, *cos, sin[1], *shift], atol=1e-6)


def test_what_is_measured_is_of_the_scale_of_what_is_learned(made):
    """A pose measured where one was commanded is the same number; states are in [-1, 1]."""
    it = made("stardiff")
    batch, command = it.batch, it.batch.command
    reached = batch.observation._replace(pose=command.pose, gripper=command.gripper)
    where = (it.stats, "rcm4")
    np.testing.assert_allclose(
        features.encode_proprioception(*where, reached, batch.trocar),
        features.encode_commands(*where, batch),
        atol=1e-6,
    )
    zeros = jnp.zeros((B, 2, 4))
    inputs = features.inference_inputs(fakes.TINY, SEEN, it.stats, batch.observation, zeros)
    state = it.stats.state.normalize(batch.observation.state)
    np.testing.assert_array_equal(inputs.history[..., 4:16], state)


def test_inference_crops_as_training_did(made, dataset):
    it = made("dp_rcm1", "image")
    settings = dataclasses.replace(fakes.TINY, observation="image", crop_fraction=0.5)
    policy = policies.make(it.method, settings, fakes.TASK, TRAIN)
    given = (it.stats, jax.random.split(jax.random.key(1), B))
    edge = it.batch.observation.images["camera"].at[..., :8, :, :].set(0)
    seen = it.batch.observation._replace(images={"camera": edge})
    one, other = (
        jit(policy.sample)(it.params, *given, o, it.batch.trocar).pose.p
        for o in (it.batch.observation, seen)
    )
    np.testing.assert_array_equal(one, other)
    assert features.crop_size(settings) == 16


def test_the_roll_network_of_training_is_that_of_sampling(made, monkeypatch):
    """Positions and the newest measured roll reach it, and its output is compared unchanged."""
    it = made("stardiff")

    def newest(self, params, p, trocar, history, seen):
        return history[:, -1:] + p[..., 0]

    monkeypatch.setattr(roll_net.RollNet, "apply", newest)
    policy = policies.make(it.method, it.settings, fakes.TASK, TRAIN)
    given, _ = prepared(it)
    _, parts = jit(policy.loss)(it.params, given)
    path, history, rolls = (x[..., 0] for x in given.lesson)
    expected = jnp.mean((rolls - history[:, -1:] - path) ** 2)
    assert float(parts["roll_loss"]) == pytest.approx(float(expected), rel=1e-5)
    seen, trocar = it.batch.observation, it.batch.trocar
    keys = jax.random.split(jax.random.key(1), B)
    pose = jit(policy.sample)(it.params, it.stats, keys, seen, trocar).pose
    measured = features.encode_proprioception(it.stats, "rcm4", seen, trocar)[..., :1]
    assert np.abs(measured[:, 1] - measured[:, 0]).max() > 1e-2
    low, high = it.stats.action.low, it.stats.action.high
    p = (pose.p[..., 0] - low[1]) * 2.0 / (high - low)[1] - 1.0
    scaled = jnp.clip(measured[:, -1:] + p, -1.0, 1.0)
    roll = (scaled + 1.0) * 0.5 * (high - low)[0] + low[0]
    np.testing.assert_allclose(rcm.roll_of(pose.R), roll, atol=1e-4)


def test_inference_reads_what_training_read(made):
    it = made("stardiff")
    where = (it.stats, "rcm4", it.batch.observation, it.batch.trocar)
    given = it.batch.observation, features.encode_proprioception(*where)
    exact = features.training_inputs(fakes.TINY, TRAIN, SEEN, it.stats, jax.random.key(0), *given)
    again = features.inference_inputs(fakes.TINY, SEEN, it.stats, *given)
    assert (exact.history[:, 0] != exact.history[:, 1]).any()
    np.testing.assert_array_equal(exact.history, again.history)


@pytest.mark.parametrize("missing", ["images", "features", "state"])
def test_what_is_not_observed_is_named(made, missing):
    it = made("stardiff")
    kind = "state" if missing == "state" else "image"
    frozen = {"freeze_encoder": missing == "features"}
    settings = dataclasses.replace(fakes.TINY, observation=kind, **frozen)
    blind = it.batch.observation._replace(images=None)
    stats = it.stats.replace(state=None)
    with pytest.raises(ValueError, match=rf"observation\.{missing}: expected .*got None"):
        features.training_inputs(
            settings, TRAIN, SEEN, stats, jax.random.key(0), blind, jnp.zeros((B, 2, 4))
        )


def test_the_roll_network_is_as_the_settings_say(made):
    it = made("stardiff")
    half = dataclasses.replace(fakes.TINY, roll_blocks=2, dtype="bfloat16")
    policy = policies.make(it.method, half, fakes.TASK, TRAIN)
    shapes = jax.eval_shape(policy.init, jax.random.key(0))["roll"]["params"]
    assert sum(name.startswith("LayerNorm") for name in shapes) == 2
    given, _ = prepared(it)
    params = jax.tree.map(lambda leaf: leaf + 0.01, it.params)
    kinds = [dataclasses.replace(fakes.TINY, dtype=dtype) for dtype in ("float32", "bfloat16")]
    makers = (policies.make(it.method, kind, fakes.TASK, TRAIN) for kind in kinds)
    exact, rough = (jit(one.loss)(params, given)[1]["roll_loss"] for one in makers)
    assert exact != rough and float(rough) == pytest.approx(float(exact), rel=0.1)
