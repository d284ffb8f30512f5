"""Packaged policies are found by name, and are whole, small, of today's networks, and scored."""

import dataclasses
import json
from pathlib import Path

import fakes
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax import rcm
from starjax.core import errors, methods
from starjax.evaluation import latency
from starjax.policies import features, packaged, policy_file
from starjax.policies import policy as policies
from starjax.sim import registries

MOST = 12e6  # bytes of a file


def shapes(params):
    leaves = jax.tree_util.tree_leaves_with_path(params)
    return {jax.tree_util.keystr(path): leaf.shape for path, leaf in leaves}


def initial(method, policy_config, task=fakes.TASK):
    """Shapes of the parameters that the networks have today."""
    whole = dataclasses.replace(policy_config, freeze_encoder=False)
    policy = policies.make(methods.METHODS[method], whole, task)
    return jax.eval_shape(policy.init, jax.random.key(0))


def faults(name):
    """What is wrong with a packaged policy, in words."""
    path = packaged.find("name", name)
    found = [] if path.stat().st_size <= MOST else [f"{name}: too large"]
    try:
        trained = policy_file.load(path)
    except ValueError as error:
        return [*found, str(error)]
    task = registries.tasks.get(trained.scene.task)
    if shapes(trained.params) != shapes(initial(trained.method, trained.policy, task)):
        found.append(f"{name}: of other networks")
    result = path.with_suffix(".json")
    if not result.is_file():
        return [*found, f"{name}: no result"]
    method = json.loads(result.read_text())["method"]
    return [*found, f"{name}: result of {method}"] if method != trained.method else found


def test_what_is_packaged_is_whole():
    assert [fault for name in packaged.names() for fault in faults(name)] == []


@pytest.mark.slow
def test_five_evaluations_side_by_side_are_enough_for_what_is_packaged(monkeypatch):
    """Pictures of noise; `benchmarks/bench_ddim.py` takes demonstrations."""
    trained = policy_file.load(packaged.find("name", "compact"))
    policy = policies.make(methods.METHODS[trained.method], trained.policy, fakes.TASK)
    observation, trocar = latency.example(trained.policy, features.select_sensors(fakes.TASK), 4)
    told = rcm.trocar_frame(trocar, fakes.P_WORLD_REF)
    keys = jax.random.split(jax.random.key(1), 4)

    def planned():
        given = (trained.params, trained.normalizer, keys, observation, told)
        return jax.jit(lambda *given: policy.sample(*given))(*given)

    wanted = planned()
    parallel_ddim = pytest.importorskip("starjax.addons.decisions.parallel_ddim")
    monkeypatch.setattr(parallel_ddim, "pays", lambda batch, steps: True)
    found = planned()
    distance = np.linalg.norm(found.pose.p - wanted.pose.p, axis=-1)
    assert 0 < distance.max() < 5e-5  # m
    np.testing.assert_allclose(found.gripper, wanted.gripper, atol=0.002)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A package with one policy, in which nothing is wrong."""
    params = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape), initial("dp_rcm2", fakes.TINY))
    made = fakes.trained(method="dp_rcm2", params=params)
    place = tmp_path / "weights"
    policy_file.save(place / "compact.safetensors", made, half=True)
    (place / "compact.json").write_text('{"method": "dp_rcm2"}')
    monkeypatch.setattr(packaged, "folders", lambda: [place])
    monkeypatch.chdir(tmp_path)
    return place


def test_faults_of_a_packaged_policy_are_found(folder):
    assert faults("compact") == []
    path = folder / "compact.safetensors"
    trained = policy_file.load(path)
    path.with_suffix(".json").write_text('{"method": "stardiff"}')
    assert faults("compact") == ["compact: result of stardiff"]
    path.with_suffix(".json").unlink()
    policy_file.save(path, trained._replace(policy=dataclasses.replace(fakes.TINY, state_dim=32)))
    assert faults("compact") == ["compact: of other networks", "compact: no result"]
    large = {**trained.params, "more": jnp.zeros(13_000_000 // 4)}
    policy_file.save(path, trained._replace(params=large))
    assert faults("compact")[0] == "compact: too large"
    path.write_bytes(path.read_bytes()[:-1])
    assert len(faults("compact")) == 2 and "not a readable" in faults("compact")[1]


def test_an_encoder_alone_stands_for_that_of_its_policy():
    """Names of features and runs hold its fingerprint, so presets find their earlier files."""
    alone = packaged.find_encoder("", "compact")
    prints = [
        policy_file.fingerprint(policy_file.load(path).params["vision"])[:16]
        for path in (alone, packaged.find("", "compact"))
    ]
    assert prints == ["d731721be39fb57b"] * 2 and alone.stat().st_size < 0.3e6


def test_the_distribution_is_found_installed_and_in_a_checkout(tmp_path, monkeypatch):
    for name, place in (("installed", tmp_path / "site"), ("checkout", tmp_path / "weights")):
        package = place / f"weights_{name}"
        package.mkdir(parents=True)
        (package / "__init__.py").touch()
        (package / "compact.safetensors").touch()
    monkeypatch.setattr(packaged, "CHECKOUT", tmp_path / "weights")
    monkeypatch.syspath_prepend(tmp_path / "site")
    for name in ("installed", "checkout"):
        monkeypatch.setattr(packaged, "PACKAGE", f"weights_{name}")
        assert packaged.locate("compact").parent.name == f"weights_{name}"
        assert packaged.is_packaged(packaged.locate("compact"))


def test_a_name_is_a_file_of_the_package(folder):
    assert packaged.names() == ["compact"]
    Path("compact").touch()
    assert packaged.find("--policy", "compact") == folder / "compact.safetensors"


def test_other_words_are_paths(folder):
    Path("compact").touch()
    for word in ("./compact", "weights/compact.safetensors"):
        assert packaged.find("--policy", word) == Path(word)
    assert packaged.locate("nowhere") == Path("nowhere")
    # A file of the package has a name there, a file of the folder that one is in has a path.
    with pytest.raises(errors.UsageError):
        packaged.find("--policy", "compact.safetensors")


def test_a_missing_file_is_one_line_that_lists_the_names(folder, tmp_path, monkeypatch):
    (folder / "needle_pick.safetensors").touch()
    (folder / "unknown.safetensors").touch()
    expected = "--policy: expected a file or one of compact, needle_pick, got compcat"
    with pytest.raises(errors.UsageError) as caught:
        packaged.find("--policy", "compcat")
    assert str(caught.value).startswith(expected) and "did you mean compact" in str(caught.value)
    monkeypatch.setattr(packaged, "folders", lambda: [tmp_path / "none"])
    line = r"^--policy: expected a file, got compact; .*pip install -e ./weights$"
    with pytest.raises(errors.UsageError, match=line):
        packaged.find("--policy", "compact")


def test_a_file_that_may_not_be_read_is_no_missing_one(monkeypatch):
    # Not by the file's mode, which does not bind the superuser.
    monkeypatch.setattr(packaged.os, "access", lambda path, mode: False)
    with pytest.raises(errors.UsageError, match=r"^name: expected a file that may be read, got "):
        packaged.find("name", packaged.names()[0])
