"""Settings that do not go together, and folders that cannot be used."""

import dataclasses
import os

import mistakes
import pytest

from starjax import cli
from starjax.cli import checks, presets, report_command
from starjax.core import config, limits, methods


@pytest.mark.parametrize(
    ("field", "changes"),
    [
        ("policy.execute", {"execute": 17}),
        ("policy.obs_horizon", {"obs_horizon": 10}),
        ("policy.horizon", {"horizon": 10}),
        ("policy.image_size", {"image_size": 34}),  # 31 pixels are left by the crop
        ("policy.image_size", {"image_size": 36}),  # 32
        ("policy.freeze_encoder", {"freeze_encoder": True}),
        ("policy.freeze_encoder", {"freeze_encoder": True, "observation": "state"}),
        ("policy.encoder_weights", {"encoder_weights": "compact", "observation": "state"}),
        ("policy.depth_encoder", {"depth_encoder": "point"}),
        ("policy.depth_encoder", {"depth_encoder": "points", "observation": "state"}),
        (
            "policy.depth_encoder",
            {"depth_encoder": "points", "encoder_weights": "compact", "freeze_encoder": True},
        ),
    ],
)
def test_settings_that_do_not_go_together_name_the_field(field, changes):
    changed = dataclasses.replace(config.PolicyConfig(), **changes)
    with mistakes.of(field):
        checks.check(config.RunConfig(policy=changed))


def test_a_method_is_a_row_of_table_ii():
    with mistakes.of("method", "'stardif'"):
        checks.check(config.RunConfig(method="stardif"))


@pytest.mark.parametrize("name", presets.PRESETS)
def test_presets_pass_their_own_checks(name):
    preset = presets.PRESETS[name]
    assert preset.preset == name
    limits.check(preset)
    for method in (*methods.METHODS, "all"):
        checks.check(dataclasses.replace(preset, method=method))


@pytest.fixture
def places(tmp_path, monkeypatch):
    """A folder with a file, one without permission to write, and inputs of report and evaluate."""
    (tmp_path / "file").touch()
    (tmp_path / "link").symlink_to("nowhere")
    (tmp_path / "closed").mkdir()
    (tmp_path / "result.json").write_text("{}")
    (tmp_path / "policy.safetensors").touch()
    is_open = os.access
    # Not by its mode, which does not bind the superuser.
    monkeypatch.setattr(
        os, "access", lambda place, mode: "closed" not in str(place) and is_open(place, mode)
    )
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("out", ["file", "file/below/it", "link", "closed", "closed/b", "x" * 300])
def test_a_folder_that_cannot_be_used_is_a_mistake_of_its_flag(out, places):
    before = sorted(places.rglob("*"))
    for command in (
        "run --preset smoke --out",
        "collect --preset smoke --out",
        "evaluate --policy policy.safetensors --out",
        "report . --out",
    ):
        with mistakes.of("--out", out):
            cli.dispatch([*command.split(), out])
    with mistakes.of("folder of OUT"):
        cli.dispatch(["pack", "policy.safetensors", f"{out}/mine.safetensors"])
    assert sorted(places.rglob("*")) == before


def test_a_report_that_cannot_be_made_leaves_nothing(places):
    before = sorted(places.rglob("*"))
    with mistakes.of("RUN", "expected schema"):
        report_command.main([".", "--out", "new"])
    assert sorted(places.rglob("*")) == before


@pytest.mark.parametrize("command", ["pack policy.safetensors new", "report . --out new"])
def test_a_platform_that_jax_cannot_use_is_a_mistake(command, places, monkeypatch):
    import jax

    def refuse():
        raise RuntimeError("no such platform")

    monkeypatch.setattr(jax, "local_devices", refuse)
    with mistakes.of("JAX_PLATFORMS", "no such platform"):
        cli.dispatch(command.split())
    assert not (places / "new").exists()
