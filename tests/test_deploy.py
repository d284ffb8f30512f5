"""A policy in someone else's program: the same commands, and mistakes that are named."""

import dataclasses

import fakes
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax import config, deploy, rcm
from starjax.data import normalizer
from starjax.experiments.methods import METHODS
from starjax.policies import policy as policies
from starjax.training import export

TRAIN = config.TrainConfig()
ROBOTS = 3


@pytest.fixture(scope="module", params=["state", "image"])
def made(request, tmp_path_factory):
    """A file of a policy with random weights; the same policy, loaded."""
    size = fakes.TINY.image_size
    settings = dataclasses.replace(fakes.TINY, observation=request.param)
    dataset = fakes.dataset(seed=0, image_size=size)
    policy = policies.make(METHODS["stardiff"], settings, fakes.P_WORLD_REF, TRAIN)
    stats = normalizer.fit(METHODS["stardiff"], dataset, fakes.P_WORLD_REF, np.arange(80))
    init = jax.jit(policy.init, compiler_options={"xla_backend_optimization_level": 0})
    trained = export.Trained(
        "stardiff", settings, TRAIN, init(jax.random.key(0)), stats, tuple(fakes.P_WORLD_REF)
    )
    path = tmp_path_factory.mktemp("deploy") / "policy.safetensors"
    export.save(path, trained)
    return path, trained, policy


def observed(settings, robots=(ROBOTS,)):
    moments, rng = (*robots, settings.obs_horizon), np.random.default_rng(0)
    is_image = settings.observation == "image"
    size = (*moments, settings.image_size, settings.image_size, 3)
    return deploy.Observation(
        pose=deploy.Pose(
            R=np.tile(np.diag([1.0, -1.0, -1.0]).astype(np.float32), (*moments, 1, 1)),
            p=rng.normal(scale=0.02, size=(*moments, 3)).astype(np.float32),
        ),
        gripper=np.ones(moments, np.float32),
        image=rng.integers(0, 256, size, np.uint8) if is_image else None,
        state=None if is_image else rng.normal(size=(*moments, 12)).astype(np.float32),
    )


def test_it_decides_as_the_policy_of_an_evaluation_does(made):
    path, trained, policy = made
    deployed, observation = deploy.load(path), observed(trained.policy)
    assert deployed.method == "stardiff" and deployed.settings == trained.policy
    trocar = jax.tree.map(lambda field: field[:ROBOTS], rcm.TROCARS)
    keys = jax.random.split(jax.random.key(7), ROBOTS)
    wanted = jax.jit(policy.sample)(trained.params, trained.normalizer, keys, observation, trocar)
    got = deployed(jax.random.key(7), observation, trocar)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), got, wanted)
    one = jax.tree.map(lambda x: x[1], (observation, trocar))
    alone = deployed(keys[1], *one)
    assert alone.pose.p.shape == (trained.policy.horizon, 3)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b[1], atol=1e-5), alone, wanted)


def test_fields_of_a_trocar_broadcast(made):
    path, trained, _ = made
    deployed, observation = deploy.load(path), observed(trained.policy)
    radius = np.full(ROBOTS, 0.02, np.float32)
    wanted = deployed(
        jax.random.key(0), observation, rcm.Trocar(radius, 0 * radius + 1.4, 0 * radius + 0.8)
    )
    got = deployed(jax.random.key(0), observation, rcm.Trocar(0.02, 1.4 + 0 * radius, 0.8))
    jax.tree.map(np.testing.assert_array_equal, got, wanted)


def test_a_mistake_names_the_array(made):
    path, trained, _ = made
    deployed, kind = deploy.load(path), trained.policy.observation
    trocar, good = rcm.Trocar(0.02, 1.4, 0.3), observed(trained.policy, ())
    turned = good.replace(pose=good.pose._replace(p=np.zeros(3)))
    mistakes = {
        r"observation.pose.p: expected shape \[2, 3\], got \[3\]": (turned, trocar),
        rf"observation.{kind}: expected shape .*, got none": (good.replace(**{kind: None}), trocar),
        r"trocar.polar: .*got 80": (good, trocar._replace(polar=80.0)),
        r"observation.pose.R: expected shape \[4, 2, 3, 3\]": (good, rcm.Trocar(*np.ones((3, 4)))),
        r"trocar: expected fields of shape \[\] or \[B\]": (good, rcm.Trocar(*np.ones((3, 1, 1)))),
    }
    if kind == "image":
        bright = good.replace(image=good.image / np.float32(255))
        mistakes["observation.image: expected uint8, got float32"] = (bright, trocar)
    for message, given in mistakes.items():
        with pytest.raises(ValueError, match=message):
            deployed(jax.random.key(0), *given)


def test_numbers_that_no_robot_measures_are_refused(made):
    path, trained, _ = made
    deployed, key = deploy.load(path), jax.random.key(0)
    good, port = observed(trained.policy, ()), rcm.Trocar(0.02, 1.4, 0.8)

    def refused(message, observation=good, trocar=port):
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
    deployed(key, good, port)


def test_a_file_that_will_not_do_is_named(made, tmp_path):
    path, trained, _ = made
    with pytest.raises(ValueError, match=r"^policy: expected a file or one of .*compact, got no"):
        deploy.load("no")
    with pytest.raises(ValueError, match=r"ddim_steps: expected 1 to .*, got 0"):
        deploy.load(path, ddim_steps=0)
    assert deploy.load(path, ddim_steps=1).settings.ddim_steps == 1
    small = {"unet": {"kernel": jnp.ones(3)}}
    export.save(tmp_path / "p", trained._replace(p_world_ref=None, params=small))
    with pytest.raises(ValueError, match="nominal port"):
        deploy.load(tmp_path / "p")
    export.save(tmp_path / "p", trained._replace(method="stardif", params=small))
    with pytest.raises(ValueError, match=r"/p: method: expected one of .*, got 'stardif'"):
        deploy.load(tmp_path / "p")


def test_a_policy_prints_as_its_settings_without_its_weights(made):
    path, trained, _ = made
    said = repr(deploy.load(path))
    assert repr(trained.policy) in said and "Array" not in said
