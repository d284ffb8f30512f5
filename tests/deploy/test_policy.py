"""A policy in someone else's program: the same commands, and mistakes that are named."""

import dataclasses
import functools
import pathlib
import pickle

import fakes
import jax
import jax.numpy as jnp
import mistakes
import numpy as np
import pytest
import strict

from starjax import deploy, rcm
from starjax.core import config
from starjax.core.errors import UsageError
from starjax.core.methods import METHODS
from starjax.core.types import Observation
from starjax.data import normalizer
from starjax.policies import policy as policies
from starjax.policies import policy_file
from starjax.policies.monitor import record, scores
from starjax.sim import names, registries

TRAIN = config.TrainConfig()
GOLDEN = pathlib.Path(__file__).parents[1] / "golden"
ROBOTS = 3
PORT = jax.tree.map(lambda field: field[0], rcm.TROCARS)
P_WORLD_REF = fakes.P_WORLD_REF[0]
SCENE = names.SceneNames("fake", ("fr5",), ("grasper",), ("camera",))


def load(path, *args, **kwargs):
    """A policy that may begin anywhere: these have random weights."""
    return deploy.load(path, *args, max_first_move=np.inf, max_first_turn=np.inf, **kwargs)


@pytest.fixture(autouse=True, scope="module")
def registered():
    """Policies find the fake tasks by their names."""
    with pytest.MonkeyPatch.context() as patch:
        tasks = registries.Registry("task", {"fake": "fakes:TASK", "fakes": "fakes:TWO_ARMS"})
        patch.setattr(registries, "tasks", tasks)
        yield


def mostly(kind, other):
    """One kind of observation; the other before a release."""
    kinds = [kind, pytest.param(other, marks=pytest.mark.release)]
    return pytest.mark.parametrize("made", kinds, indirect=True)


MOSTLY_STATES, MOSTLY_IMAGES = mostly("state", "image"), mostly("image", "state")


@pytest.fixture(scope="module", params=["state", "image"])
def made(request, tmp_path_factory):
    """A file of a policy with random weights; the same policy, loaded."""
    size = fakes.TINY.image_size
    settings = dataclasses.replace(fakes.TINY, observation=request.param)
    dataset = fakes.dataset(seed=0, image_size=size)
    policy = policies.make(METHODS["stardiff"], settings, fakes.TASK, TRAIN)
    stats = normalizer.fit(METHODS["stardiff"], fakes.TASK, dataset, np.arange(80))
    trained = fakes.trained(
        policy=settings, params=fakes.params(policy), normalizer=stats, scene=SCENE
    )
    path = tmp_path_factory.mktemp("deploy") / "policy.safetensors"
    policy_file.save(path, trained)
    return path, trained, policy


@functools.cache
def shared(path):
    """The policy of `made`, compiled once for all tests that only ask it."""
    return load(path)


def observed(settings, robots=(ROBOTS,)):
    """Tools through the first trocars, near the board."""
    moments, rng = (*robots, settings.obs_horizon), np.random.default_rng(0)
    count = robots[0] if robots else 1
    port = jax.tree.map(lambda field: field[:count, None], rcm.TROCARS)
    parts = np.zeros((count, settings.obs_horizon, 4), np.float32)
    parts[..., 1:] = np.array([0.0, 0.0, 0.02]) + rng.normal(scale=0.01, size=parts[..., 1:].shape)
    pose, _ = rcm.ACTION_SPACES["rcm4"].decode(parts, port, P_WORLD_REF)
    is_image = settings.observation == "image"
    size = (*moments, settings.image_size, settings.image_size, 3)
    return deploy.Observation(
        pose=jax.tree.map(lambda x: np.asarray(x).reshape(*moments, *x.shape[2:]), pose),
        gripper=np.ones(moments, np.float32),
        image=rng.integers(0, 256, size, np.uint8) if is_image else None,
        state=None if is_image else rng.normal(size=(*moments, 12)).astype(np.float32),
    )


def of_one_arm(observation):
    """As the policy itself takes it."""
    pose = deploy.Pose(observation.pose.R[:, :, None], observation.pose.p[:, :, None])
    images = None if observation.image is None else {"camera": observation.image}
    return Observation(pose, observation.gripper[..., None], images, observation.state)


@pytest.mark.slow
@MOSTLY_IMAGES
def test_it_decides_as_the_policy_of_an_evaluation_does(made):
    path, trained, policy = made
    deployed, observation = load(path), observed(trained.policy)
    assert deployed.method == "stardiff" and deployed.settings == trained.policy
    trocar = jax.tree.map(lambda field: field[:ROBOTS], rcm.TROCARS)
    keys = jax.random.split(jax.random.key(7), ROBOTS)
    given = keys, of_one_arm(observation), fakes.told(trocar)
    said = jax.jit(policy.sample)(trained.params, trained.normalizer, *given)
    R, p = (part[:, :, 0] for part in said.pose)
    wanted = deploy.Command(deploy.Pose(R, p), said.gripper[..., 0])
    got = deployed(jax.random.key(7), observation, trocar)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), got, wanted)
    old = deployed(jax.random.key_data(jax.random.key(7)), observation, trocar)
    jax.tree.map(np.testing.assert_array_equal, old, got)
    one = jax.tree.map(lambda x: x[1], (observation, trocar))
    alone = deployed(keys[1], *one)
    assert alone.pose.p.shape == (trained.policy.horizon, 3)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b[1], atol=1e-5), alone, wanted)


@pytest.mark.slow
@pytest.mark.release
def test_it_decides_alike_whatever_a_program_makes_jax_refuse(made):
    path, trained, _ = made
    arguments = jax.random.key(7), observed(trained.policy, ()), PORT
    wanted = load(path)(*arguments)
    placed = jax.device_put(arguments)
    # These have no rule for `vmap`, under which a decision draws its noise.
    strange = {name for name in strict.STRICT if "error_checking" in name}
    with strict.mode({k: v for k, v in strict.STRICT.items() if k not in strange}):
        deployed = load(path)
        got, compiled = deployed(*arguments), jax.jit(deployed)(*placed)
        got, compiled = jax.device_get((got, compiled))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), got, wanted)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), compiled, wanted)


def test_a_program_keeps_its_settings_of_jax(made):
    path, trained, _ = made
    before = {name: jax.config.values[name] for name in jax.config.values}
    shared(path)(jax.random.key(7), observed(trained.policy, ()), PORT)
    assert {name: jax.config.values[name] for name in jax.config.values} == before


@MOSTLY_STATES
def test_it_pickles_by_its_file(made):
    path, trained, _ = made
    deployed = dataclasses.replace(load(path, ddim_steps=3), max_first_turn=9.0)
    said = pickle.dumps(deployed)
    assert len(said) < 1000
    again = pickle.loads(said)
    assert again.settings == deployed.settings and again.method == deployed.method
    assert (again.max_first_move, again.max_first_turn) == (np.inf, 9.0)
    arguments = jax.random.key(7), observed(trained.policy, ()), PORT
    jax.tree.map(np.testing.assert_array_equal, again(*arguments), deployed(*arguments))


@MOSTLY_STATES
def test_a_file_that_changed_is_not_the_policy_that_was_pickled(made, tmp_path):
    path, trained, _ = made
    other = tmp_path / "policy.safetensors"
    other.write_bytes(path.read_bytes())
    said = pickle.dumps(load(other))
    policy_file.save(other, trained._replace(preset="smoke"))
    with pytest.raises(UsageError) as caught:
        pickle.loads(said)
    assert caught.value.argument == "policy" and caught.value.got == str(other)


@MOSTLY_STATES
def test_fields_of_a_trocar_broadcast(made):
    path, trained, _ = made
    deployed, observation = shared(path), observed(trained.policy)
    one = jax.tree.map(lambda x: np.repeat(x[:1], ROBOTS, 0), observation)
    port = jax.tree.map(lambda field: field[:1].repeat(ROBOTS), rcm.TROCARS)
    wanted = deployed(jax.random.key(0), one, port)
    lists = rcm.Trocar(*(field.tolist() for field in port))
    for given in (port._replace(radius=PORT.radius, azimuth=PORT.azimuth), PORT, lists):
        got = deployed(jax.random.key(0), one, given)
        jax.tree.map(np.testing.assert_array_equal, got, wanted)


def test_a_mistake_names_the_array(made):
    path, trained, _ = made
    deployed, kind = shared(path), trained.policy.observation
    trocar, good = PORT, observed(trained.policy, ())
    turned = good.replace(pose=good.pose._replace(p=np.zeros(3)))
    mistakes = {
        r"observation.pose.p: expected shape \[2, 3\], got \[3\]": (turned, trocar),
        rf"observation.{kind}: expected shape .*, got none": (good.replace(**{kind: None}), trocar),
        r"trocar.polar: .*got 80": (good, trocar._replace(polar=80.0)),
        r"observation.pose.R: expected shape \[4, 2, 3, 3\]": (
            good,
            rcm.Trocar(*np.full((3, 4), 0.1)),
        ),
        r"trocar: expected fields of shape \[\] or \[B\]": (
            good,
            rcm.Trocar(*np.full((3, 1, 1), 0.1)),
        ),
        r"trocar: expected fields of shape \[\] or \[B\], got \[0\]": (
            observed(trained.policy, (0,)),
            rcm.Trocar(*np.zeros((3, 0))),
        ),
        r"observation.pose.R: expected shape .*, got none": (good.replace(pose=None), trocar),
        r"observation.pose: expected a deploy.Pose, got ndarray": (
            good.replace(pose=np.zeros((2, 4, 4))),
            trocar,
        ),
        r"observation.pose: expected a deploy.Pose, got dict": (
            good.replace(pose=good.pose._asdict()),
            trocar,
        ),
        r"observation.gripper: expected shape .*, got none": (good.replace(gripper=None), trocar),
        r"observation.gripper: expected real numbers, got complex": (
            good.replace(gripper=good.gripper * 1j),
            trocar,
        ),
        r"observation.gripper: expected real numbers, got <U": (
            good.replace(gripper=["open", "shut"]),
            trocar,
        ),
        r"observation: expected a deploy.Observation, got NoneType": (None, trocar),
    }
    if kind == "image":
        bright = good.replace(image=good.image / np.float32(255))
        mistakes["observation.image: expected uint8, got float32"] = (bright, trocar)
    for message, given in mistakes.items():
        with pytest.raises(ValueError, match=message):
            deployed(jax.random.key(0), *given)
    keys = jax.random.split(jax.random.key(0), 3)
    for no_key in (0, keys, *map(np.zeros, (2, (1, 2))), np.zeros(3, np.uint32), np.array([0, 1])):
        with pytest.raises(UsageError) as caught:
            deployed(no_key, good, trocar)
        assert caught.value.argument == "key"


def test_numbers_that_no_robot_measures_are_refused(made):
    path, trained, _ = made
    deployed, key = shared(path), jax.random.key(0)
    good = observed(trained.policy, ())

    def refused(message, observation=good, trocar=PORT):
        with pytest.raises(ValueError, match=message):
            deployed(key, observation, trocar)

    bad = np.full_like(good.gripper, np.nan)
    refused("observation.gripper: expected finite", good.replace(gripper=bad))
    for name, turn in (("pose.p", lambda x: x + np.inf), ("pose.R", lambda x: x * np.nan)):
        part = name.removeprefix("pose.")
        pose = good.pose._replace(**{part: turn(getattr(good.pose, part))})
        refused(f"observation.{name}: expected finite", good.replace(pose=pose))
    for R in (np.zeros_like(good.pose.R), -good.pose.R, 1.1 * good.pose.R):
        refused("pose.R: expected rotations", good.replace(pose=good.pose._replace(R=R)))
    refused(r"trocar.radius: expected at most 0.5 m, got 14", trocar=rcm.Trocar(14.0, 1.4, 0.8))
    refused("trocar: expected an rcm.Trocar, got list", trocar=[0.02, 1.4, 0.8])
    wrapped = np.full_like(good.gripper, -128, np.int8)  # its own absolute value
    refused("observation.gripper: .*, got -128", good.replace(gripper=wrapped))
    refused("observation.gripper: .*, got 3.6", good.replace(gripper=3.6 * good.gripper))
    in_mm = good.replace(pose=good.pose._replace(p=1e3 * good.pose.p))
    refused("observation.pose.p: expected tips within 0.5 m", in_mm)
    other = jax.tree.map(lambda field: field[4], rcm.TROCARS)
    refused("max_off_trocar", trocar=other)
    with pytest.raises(ValueError, match=r"trocar.radius: expected at most 0.5 m, got 14"):
        jax.jit(lambda key: deployed(key, good, PORT._replace(radius=14.0)))(key)
    deployed(key, good, PORT)
    half = jax.tree.map(lambda x: x.astype(np.float16), good.pose)
    deployed(key, good.replace(pose=half), PORT)


def test_what_the_policy_does_not_look_at_is_not_looked_at(made):
    path, trained, _ = made
    deployed, key, good = shared(path), jax.random.key(0), observed(trained.policy, ())
    wanted = deployed(key, good, PORT)
    unused = "state" if trained.policy.observation == "image" else "image"
    more = good.replace(**{unused: np.full((2, 12), np.nan)})
    jax.tree.map(np.testing.assert_array_equal, deployed(key, more, PORT), wanted)
    lists = jax.tree.map(lambda x: x.tolist() if x.dtype != np.uint8 else list(x), good)
    jax.tree.map(np.testing.assert_array_equal, deployed(key, lists, PORT), wanted)


def test_a_tool_half_a_turn_away_is_the_same_tool(made):
    path, trained, _ = made
    deployed, key, good = shared(path), jax.random.key(0), observed(trained.policy, ())
    half = np.diag([-1.0, -1.0, 1.0]).astype(np.float32)
    turned = good.replace(pose=good.pose._replace(R=good.pose.R @ half))
    wanted, got = deployed(key, good, PORT), deployed(key, turned, PORT)
    np.testing.assert_array_equal(got.pose.p, wanted.pose.p)
    np.testing.assert_array_equal(got.pose.R, wanted.pose.R @ half)


@MOSTLY_STATES
def test_methods_that_share_weights_are_each_deployed(made, tmp_path):
    _, trained, _ = made
    stats = normalizer.fit(METHODS["dp_ee"], fakes.TASK, fakes.dataset(0), np.arange(80))
    policy = policies.make(METHODS["dp_ee"], trained.policy, fakes.TASK, TRAIN)
    params = fakes.params(policy)
    file = tmp_path / "policy.safetensors"
    policy_file.save(file, trained._replace(method="dp_ee", params=params, normalizer=stats))
    off = {}
    for name in ("dp_ee", "dp_ee_proj"):
        deployed = load(file, method=name)
        pose = deployed(jax.random.key(0), observed(trained.policy, ()), PORT).pose
        off[name] = rcm.rcm_error(pose, rcm.trocar_position(PORT, P_WORLD_REF)).max()
    assert deployed.method == "dp_ee_proj" and off["dp_ee_proj"] < 1e-6 < 1e-3 < off["dp_ee"]
    assert load(file).method == "dp_ee"
    with pytest.raises(ValueError, match=r"method: expected one of dp_ee, dp_ee_proj, got 'star"):
        load(file, method="stardiff")


@MOSTLY_STATES
def test_a_file_that_will_not_do_is_named(made, tmp_path):
    path, trained, _ = made
    with pytest.raises(ValueError, match=r"^policy: expected a file or one of .*compact.*, got no"):
        deploy.load("no")
    for options in ({"ddim_steps": 1}, {"ddim_steps": 101}, {"ddim_steps": 2.5}, {"steps": 2}):
        with pytest.raises(ValueError, match="ddim_steps"):
            load(path, **options)
    changed = load(path, ddim_steps=np.int32(3), temperature=0.5)
    assert changed.settings == config.with_options(trained.policy, ddim_steps=3, temperature=0.5)
    small = {"unet": {"kernel": jnp.ones(3)}}
    policy_file.save(tmp_path / "p", trained._replace(p_world_ref=None, params=small))
    with pytest.raises(ValueError, match="nominal trocar"):
        load(tmp_path / "p")
    policy_file.save(tmp_path / "p", trained._replace(method="stardif", params=small))
    with pytest.raises(ValueError, match=r"/p: method: expected one of .*, got 'stardif'"):
        load(tmp_path / "p")


@MOSTLY_STATES
def test_a_policy_prints_as_its_settings_without_its_weights(made):
    path, trained, _ = made
    said = repr(shared(path))
    assert repr(trained.policy) in said and "Array" not in said


def test_what_sensors_are_off_is_not_refused(made):
    path, trained, _ = made
    deployed, key = shared(path), jax.random.key(0)
    good = observed(trained.policy, ())
    deployed(key, good.replace(gripper=1.05 * good.gripper), PORT)
    pose = good.pose._replace(R=1.01 * good.pose.R, p=good.pose.p + 0.002 * good.pose.R[..., 0])
    deployed(key, good.replace(pose=pose), PORT)


@MOSTLY_STATES
def test_a_tool_through_another_port_is_refused_where_the_policy_keeps_to_it(made, tmp_path):
    _, trained, _ = made
    stats = normalizer.fit(METHODS["dp_ee"], fakes.TASK, fakes.dataset(0), np.arange(80))
    policy = policies.make(METHODS["dp_ee"], trained.policy, fakes.TASK, TRAIN)
    params = fakes.params(policy)
    file, other = tmp_path / "policy.safetensors", jax.tree.map(lambda x: x[4], rcm.TROCARS)
    policy_file.save(file, trained._replace(method="dp_ee", params=params, normalizer=stats))
    given = jax.random.key(0), observed(trained.policy, ()), other
    load(file)(*given)
    with mistakes.of("observation.pose", "mm"):
        load(file, method="dp_ee_proj")(*given)


@MOSTLY_STATES
def test_a_trocar_beside_the_shaft_is_refused_by_the_owners_bound(made):
    file, trained, _ = made
    seen, policy = observed(trained.policy, ()), shared(file)
    strict_policy = load(file, max_off_trocar=1e-3)
    where = np.asarray(rcm.trocar_position(PORT, policy.p_world_ref))

    def beside(loaded, metres):
        trocar = rcm.trocar_from_position(where + np.float32([metres, 0, 0]), loaded.p_world_ref)
        return loaded(jax.random.key(0), seen, trocar)

    beside(policy, 0.001)
    for loaded, metres in ((policy, 0.004), (policy, 0.019), (strict_policy, 0.002)):
        with mistakes.of("observation.pose", "mm"):
            beside(loaded, metres)
    beside(load(file, max_off_trocar=0.01), 0.004)
    with mistakes.of("max_off_trocar"):
        load(file, max_off_trocar=0.0)


@pytest.mark.parametrize("rolls", [(1.4, 1.7), (1.7, 1.4)])
def test_the_newest_moment_says_which_way_a_tool_is_turned(made, rolls):
    """An untrained policy commands a roll near the tool's, about zero."""
    path, trained, _ = made
    good = observed(trained.policy, ())
    R = rcm.rotation_from_axis_roll(good.pose.R[..., 2], np.float32(rolls))
    turned = good.replace(pose=good.pose._replace(R=R))
    roll = np.abs(rcm.roll_of(shared(path)(jax.random.key(0), turned, PORT).pose.R))
    assert ((roll > np.pi / 2) == (rolls[1] > np.pi / 2)).all()


@MOSTLY_STATES
def test_it_may_be_part_of_a_program(made):
    path, trained, _ = made
    deployed, given = shared(path), (observed(trained.policy, ()), PORT)
    wanted = deployed(jax.random.key(0), *given)
    got = jax.jit(deployed)(jax.random.key(0), *jax.tree.map(jnp.asarray, given))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), got, wanted)
    port = jax.tree.map(jnp.asarray, PORT)
    got = jax.jit(lambda key, seen: deployed(key, seen, port))(jax.random.key(0), given[0])
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), got, wanted)


@MOSTLY_IMAGES
def test_it_plans_the_same_in_a_program_of_double_precision(made):
    path, trained, _ = made
    deployed, good, key = shared(path), observed(trained.policy), jax.random.key(0)
    ports = jax.tree.map(lambda field: field[:ROBOTS], rcm.TROCARS)
    wanted = deployed(key, good, ports)
    with jax.enable_x64(True):
        pose = jax.tree.map(np.float64, good.pose)
        got = deployed(key, good.replace(pose=pose), ports)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), got, wanted)


@pytest.mark.parametrize("made", ["image"], indirect=True)
def test_pictures_are_cropped_as_in_its_training(made, tmp_path):
    _, trained, _ = made
    half = dataclasses.replace(trained.policy, crop_fraction=0.5)
    policy_file.save(tmp_path / "p", trained._replace(policy=half))
    deployed, good = load(tmp_path / "p"), observed(trained.policy, ())
    edge = good.image.copy()
    edge[:, :8] = 0
    one, other = (deployed(jax.random.key(0), x, PORT) for x in (good, good.replace(image=edge)))
    jax.tree.map(np.testing.assert_array_equal, one, other)


def test_one_number_of_one_robot_is_enough_to_refuse(made):
    path, trained, _ = made
    deployed, good = shared(path), observed(trained.policy)
    ports = jax.tree.map(lambda field: field[:ROBOTS].copy(), rcm.TROCARS)

    def changed(x, value):
        x = np.array(x)
        x[1, 0] = value(x[1, 0])
        return x

    pose, mirror = good.pose, np.diag([-1.0, 1.0, 1.0]).astype(np.float32)
    bad = {
        "gripper: expected finite": {"gripper": changed(good.gripper, lambda x: np.nan)},
        "gripper: expected values": {"gripper": changed(good.gripper, lambda x: -2.0)},
        "R: expected rot": {"pose": pose._replace(R=changed(pose.R, lambda x: x @ mirror))},
        "R: expected rotations": {"pose": pose._replace(R=changed(pose.R, lambda x: 1.1 * x))},
        "p: expected tips": {"pose": pose._replace(p=changed(pose.p, lambda x: x + 1.0))},
        "max_off_trocar": {
            "pose": pose._replace(p=changed(pose.p, lambda x: x + np.eye(3)[0] * 0.05))
        },
    }
    if good.state is not None:
        bad["state: expected finite"] = {"state": changed(good.state, lambda x: x * np.nan)}
    for message, fields in bad.items():
        with pytest.raises(ValueError, match=message):
            deployed(jax.random.key(0), good.replace(**fields), ports)
    ports.radius[1] = 0.6
    with pytest.raises(ValueError, match=r"trocar.radius: expected at most 0.5 m, got 0.6"):
        deployed(jax.random.key(0), good, ports)


@pytest.fixture(scope="module")
def two_arms(tmp_path_factory):
    """A policy of two arms that face each other, with two cameras, and its file's content."""
    settings = dataclasses.replace(fakes.TINY, observation="image")
    dataset = fakes.dataset(seed=0, image_size=settings.image_size, arms=2)
    row = METHODS["stardiff"]
    cameras = ("wrist", "camera")
    policy = policies.make(row, settings, fakes.TWO_ARMS, TRAIN, cameras)
    stats = normalizer.fit(row, fakes.TWO_ARMS, dataset, np.arange(80))
    trained = fakes.trained(
        policy=settings,
        params=fakes.params(policy),
        normalizer=stats,
        scene=names.SceneNames("fakes", ("fr5", "fr5"), ("grasper", "grasper"), cameras),
        p_world_ref=tuple(slot.p_world_ref for slot in fakes.TWO_ARMS.slots),
        roll_zero=tuple(slot.roll_zero for slot in fakes.TWO_ARMS.slots),
    )
    path = tmp_path_factory.mktemp("two") / "policy.safetensors"
    policy_file.save(path, trained)
    return load(path), dataset


def test_several_arms_have_an_axis_and_several_cameras_names(two_arms):
    deployed, dataset = two_arms
    frames, rng = np.array([3, 4]), np.random.default_rng(0)
    pose = jax.tree.map(lambda x: np.asarray(x)[frames], dataset.observation.pose)
    images = {name: rng.integers(0, 256, (2, 32, 32, 3), np.uint8) for name in ("camera", "wrist")}
    good = deploy.Observation(pose, np.ones((2, 2)), images=images)
    trocar = jax.tree.map(lambda x: np.asarray(x)[0], dataset.trocar.trocar)
    command = deployed(jax.random.key(0), good, trocar)
    assert command.pose.R.shape == (16, 2, 3, 3) and command.gripper.shape == (16, 2)
    through = dataset.trocar.p_world_trocar[0]
    assert np.asarray(rcm.rcm_error(command.pose, through)).max() < 1e-6
    both = jax.tree.map(lambda x: np.stack([x, x]), good)
    traced = jax.eval_shape(deployed, jax.random.key(0), both, trocar)
    assert traced.pose.p.shape == (2, 16, 2, 3)
    # An untrained policy says a roll of about the zero of each arm, which face each other.
    roll = np.asarray(rcm.roll_of(command.pose.R))
    assert (np.abs(roll[:, 0]) < np.pi / 2).all() and (np.abs(roll[:, 1]) > np.pi / 2).all()
    swapped = {"camera": images["wrist"], "wrist": images["camera"]}
    other = deployed(jax.random.key(0), good.replace(images=swapped), trocar)
    assert np.abs(other.pose.p - command.pose.p).max() > 1e-5


def test_a_mistake_of_several_arms_or_cameras_is_named(two_arms):
    deployed, dataset = two_arms
    pose = jax.tree.map(lambda x: np.asarray(x)[np.array([3, 4])], dataset.observation.pose)
    images = {"camera": np.zeros((2, 32, 32, 3), np.uint8)}
    good = deploy.Observation(pose, np.ones((2, 2)), images=images)
    trocar = jax.tree.map(lambda x: np.asarray(x)[0], dataset.trocar.trocar)
    mistakes = {
        "observation.images['wrist']": (good, trocar),
        "observation.gripper": (good.replace(gripper=np.ones(2)), trocar),
        "trocar": (good, jax.tree.map(lambda x: np.repeat(x, 2)[:3], trocar)),
    }
    for argument, given in mistakes.items():
        with pytest.raises(UsageError) as caught:
            deployed(jax.random.key(0), *given)
        assert caught.value.argument == argument


@pytest.mark.parametrize("prefix", ["", pytest.param("one_", marks=pytest.mark.release)])
def test_the_packaged_policy_commands_what_it_did(prefix, monkeypatch):
    tasks = registries.Registry("task", {"peg_transfer": "fakes:TASK"})
    monkeypatch.setattr(registries, "tasks", tasks)
    before, deployed = np.load(GOLDEN / "compact_commands.npz"), load("compact")
    i, j, c = np.ogrid[:128, :128, :3]
    images = [(37 * i + 91 * j + 17 * c + 53 * o) % 256 for o in range(6)]
    observation = deploy.Observation(
        pose=deploy.Pose(before["seen_R"], before["seen_p"]),
        gripper=np.array([[1, 1], [0.5, 0.2], [-1, -1]], np.float32),
        image=np.stack(images).astype(np.uint8).reshape(3, 2, 128, 128, 3),
    )
    trocars = jax.tree.map(lambda field: field[:3], rcm.TROCARS)
    given = jax.random.key(7), observation, trocars
    if prefix:
        given = jax.random.key(3), *jax.tree.map(lambda x: x[1], (observation, trocars))
    command = deployed(*given)
    np.testing.assert_allclose(command.pose.p, before[f"{prefix}p"], atol=1e-6)
    np.testing.assert_allclose(command.pose.R, before[f"{prefix}R"], atol=1e-6)
    np.testing.assert_allclose(command.gripper, before[f"{prefix}gripper"], atol=1e-6)


def test_a_monitor_is_loaded_unless_an_option_changes_the_plans(made, tmp_path):
    path, trained, _ = made
    assert load(path).monitor is None
    monitor = record.Monitor(
        np.zeros(len(scores.NAMES)), np.ones(len(scores.NAMES)),
        1.0, 7.9, 0.05, 20, scores.ScoreSettings(8, 30.0, 6),
        policy_file.monitor_digest(trained.params),
    )  # fmt: skip
    policy_file.save(tmp_path / "watched.safetensors", trained._replace(monitor=monitor))
    watched = load(tmp_path / "watched.safetensors")
    assert watched.monitor is not None
    assert record.to_json(watched.monitor) == record.to_json(monitor)
    assert load(tmp_path / "watched.safetensors", temperature=0.0).monitor is None
