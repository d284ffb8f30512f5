"""Presets: starting values of a run, and which of them `auto` means."""

import dataclasses
import json

import pytest

from starjax import config
from starjax.experiments import presets, run


def test_auto_is_named_by_what_it_picked(monkeypatch):
    monkeypatch.setattr(presets, "has_gpu", lambda: False)
    assert run.settings([], "", "").preset == "cpu"
    monkeypatch.setattr(presets, "has_gpu", lambda: True)
    assert run.settings(["--preset", "auto"], "", "").preset == "gpu"


def test_jax_platforms_forbids_the_gpu(monkeypatch):
    monkeypatch.setattr(presets, "has_gpu_device", lambda: True)
    monkeypatch.setattr(presets, "has_gpu_plugin", lambda: True)
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    assert not presets.has_gpu()
    monkeypatch.setenv("JAX_PLATFORMS", "cpu,cuda")  # jax takes the first
    assert not presets.has_gpu()
    monkeypatch.setenv("JAX_PLATFORMS", "cuda,cpu")
    assert presets.has_gpu()


@pytest.mark.parametrize(("visible", "seen"), [("", False), ("-1", False), ("1", True)])
def test_a_gpu_may_be_hidden(monkeypatch, visible, seen):
    monkeypatch.setattr(presets, "has_gpu_device", lambda: True)
    monkeypatch.setattr(presets, "has_gpu_plugin", lambda: True)
    monkeypatch.delenv("JAX_PLATFORMS", raising=False)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    assert presets.has_gpu() == seen


@pytest.mark.parametrize(("device", "plugin"), [(True, False), (False, True)])
def test_a_gpu_is_a_device_with_its_plugin(monkeypatch, device, plugin):
    monkeypatch.setattr(presets, "has_gpu_device", lambda: device)
    monkeypatch.setattr(presets, "has_gpu_plugin", lambda: plugin)
    for name in ("JAX_PLATFORMS", "CUDA_VISIBLE_DEVICES"):
        monkeypatch.delenv(name, raising=False)
    assert not presets.has_gpu()


def test_paper_preset_is_the_default_configuration():
    paper = presets.PRESETS["paper"]
    assert dataclasses.replace(paper, preset="auto") == config.RunConfig()
    assert (paper.train.steps, paper.train.batch_size) == (100_000, 256)


@pytest.mark.parametrize("name", presets.PRESETS)
def test_configuration_survives_json(name):
    values = json.loads(json.dumps(dataclasses.asdict(presets.PRESETS[name])))
    assert config.from_dict(config.RunConfig, values) == presets.PRESETS[name]
    with pytest.raises(ValueError, match="stepps"):
        config.from_dict(config.TrainConfig, {"stepps": 1})
