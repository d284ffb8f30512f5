"""`starjax pack`: its file, its output, and mistakes in one line."""

import dataclasses
import json
import re

import fakes
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import safetensors.numpy
import yaml

from starjax.cli import pack
from starjax.core import config, errors
from starjax.data import normalizer
from starjax.policies import packaged, policy_file
from starjax.policies.monitor import record, scores

POLICY = config.with_options(dataclasses.replace(fakes.TINY, dtype="bfloat16"), temperature=0.5)


def save(path, scale=1.0):
    kernel = scale * jax.random.normal(jax.random.key(0), (300, 1000))
    box = normalizer.MinMax(-jnp.ones(5), jnp.full(5, 1 / 3))
    stats = normalizer.Normalizer(box, None)
    train = config.TrainConfig(steps=7)
    made = fakes.trained(
        method="dp_rcm2", policy=POLICY, train=train, params={"learner": kernel}, normalizer=stats
    )
    policy_file.save(path, made)
    return made


@pytest.fixture
def made(tmp_path, monkeypatch):
    """A policy, in mine.safetensors of an empty working folder."""
    monkeypatch.chdir(tmp_path)
    return save(tmp_path / "mine.safetensors")


@pytest.mark.parametrize(("argv", "temperature"), [([], 0.5), (["--temperature", "0"], 0.0)])
def test_a_packed_policy_is_small_and_for_a_cpu(made, tmp_path, capsys, argv, temperature):
    assert pack.main(["mine.safetensors", "out/compact.safetensors", *argv]) == 0
    out = tmp_path / "out" / "compact.safetensors"
    found = policy_file.load(out)
    float32 = dataclasses.replace(POLICY, dtype="float32")
    assert found.policy == config.with_options(float32, temperature=temperature)
    assert (found.method, found.train) == (made.method, made.train)
    np.testing.assert_allclose(
        found.params["learner"], made.params["learner"], rtol=2**-11, atol=3e-8
    )
    jax.tree.map(np.testing.assert_array_equal, found.normalizer, made.normalizer)
    assert 600_000 < out.stat().st_size < 605_000
    said = capsys.readouterr().out
    for words in (
        "0.3 M parameters, 60",
        " kB (mine.safetensors: 1.2 MB)",
        f"temperature {temperature:g}",
    ):
        assert words in said


def test_a_card_has_the_trials_of_the_result(made, tmp_path):
    assert pack.main(["mine.safetensors", "plain.safetensors"]) == 0
    assert "None recorded" in (tmp_path / "plain.md").read_text()
    found = json.loads(packaged.find("name", "compact").with_suffix(".json").read_text())
    (tmp_path / "result.json").write_text(json.dumps(found | {"commit": "c0ffee"}))
    assert pack.main(["mine.safetensors", "mine2.safetensors"]) == 0
    card = (tmp_path / "mine2.md").read_text()
    header = yaml.safe_load(card.split("---")[1])
    assert header["license"] == "apache-2.0" and made.scene.task in header["tags"]
    rows = re.findall(r"\((\d+)/(\d+)\)", card)
    assert [int(n) for _, n in rows] == [800, 400] + [100] * 12
    assert sum(int(n) for n, _ in rows[2:]) == found["strict"]["all"]["successes"]
    assert "c0ffee" in card and found["command"] in card


@pytest.mark.parametrize(
    ("argv", "argument", "got"),
    [
        ("mine.safetensors", "OUT", "none"),
        ("nowhere out", "POLICY", "nowhere"),
        ("other out", "POLICY", "other: not a readable"),
        ("nameless out", "POLICY", "does not say which policy"),
        ("large out", "POLICY", "learner"),
        ("mine.safetensors ./mine.safetensors", "OUT", "./mine.safetensors"),
        ("mine.safetensors .", "OUT", "."),
        ("mine.safetensors out --temperature 2", "temperature", "2.0"),
        ("mine.safetensors out --temperature -1", "temperature", "-1.0"),
        ("mine.safetensors out --temperature nan", "temperature", "nan"),
        ("mine.safetensors out --temperature x", "--temperature", "'x'"),
        ("mine.safetensors out --temprature 1", "FLAG", "--temprature"),
    ],
)
def test_a_mistake_names_what_was_wrong(made, tmp_path, argv, argument, got):
    (tmp_path / "other").write_bytes(b"x" * 100)
    save(tmp_path / "large", scale=1e5)
    safetensors.numpy.save_file({"w": np.zeros(1)}, tmp_path / "nameless")
    before = (tmp_path / "mine.safetensors").read_bytes()
    with pytest.raises(errors.UsageError) as caught:
        pack.main(argv.split())
    assert caught.value.argument == argument and got in str(caught.value.got)
    assert not (tmp_path / "out").exists()
    assert (tmp_path / "mine.safetensors").read_bytes() == before


@pytest.mark.parametrize("argv", [[], ["--temperature", "0.5"], ["--temperature", "0"]])
def test_a_monitor_is_kept_unless_samples_change(made, argv):
    monitor = record.Monitor(
        np.zeros(len(scores.NAMES)), np.ones(len(scores.NAMES)),
        1.0, 7.9, 0.05, 20, scores.ScoreSettings(8, 30.0, 6),
        policy_file.monitor_digest(made.params),
    )  # fmt: skip
    policy_file.save("monitored.safetensors", made._replace(monitor=monitor))
    assert pack.main(["monitored.safetensors", "small.safetensors", *argv]) == 0
    is_kept = policy_file.load("small.safetensors").monitor is not None
    assert is_kept == (argv[-1:] != ["0"])
