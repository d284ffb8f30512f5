"""A run's folder: settings that may and may not change, twins, time by stage."""

import dataclasses
import errno
import json
import os
import re
import shutil
import time

import mistakes
import numpy as np
import pytest

from starjax.cli import folders, presets, stage_times
from starjax.core import config, config_json, errors, methods
from starjax.runtime import files

SMOKE = presets.PRESETS["smoke"]


def claimed(folder, *rest):
    """A folder in which training has begun."""
    folders.claim(folder, SMOKE, "demos-a", *rest)
    (folder / "policy.safetensors").touch()


def changed(**parts):
    fields = {
        name: dataclasses.replace(getattr(SMOKE, name), **value) if name != "seed" else value
        for name, value in parts.items()
    }
    return dataclasses.replace(SMOKE, **fields)


def another(value):
    match value:
        case bool():
            return not value
        case str():
            return value + "x"
        case tuple():
            return (*value, "x")
    return value + 1


def test_weights_of_another_seed_are_refused(tmp_path):
    claimed(tmp_path)
    with mistakes.of("seed", 1) as caught:
        folders.claim(tmp_path, changed(seed=1), "demos-a")
    assert "--out" in caught.value.hint


@pytest.mark.parametrize("part", ["scene", "demos", "policy", "train"])
def test_every_setting_but_three_decides_the_weights(tmp_path, part):
    claimed(tmp_path)
    settings = getattr(SMOKE, part)
    free = {"keep_checkpoints", "checkpoint_every", "steps_per_call", "learner"}
    for name in config_json.as_json(settings).keys() - free:
        if hasattr(settings, name):
            now = dataclasses.replace(settings, **{name: another(getattr(settings, name))})
        else:  # options of the learner's
            now = config.with_options(settings, **{name: another(getattr(settings.options, name))})
        other = dataclasses.replace(SMOKE, **{part: now})
        with mistakes.of(f"{part}.{name}"):
            folders.claim(tmp_path, other, "demos-a")


def test_weights_of_another_scene_are_refused(tmp_path):
    claimed(tmp_path)
    with mistakes.of("the demonstrations", "demos-b") as caught:
        folders.claim(tmp_path, SMOKE, "demos-b")
    assert "demos-a" in caught.value.expected


def test_weights_of_other_settings_of_jax_are_refused(tmp_path, monkeypatch):
    claimed(tmp_path)
    monkeypatch.setenv("NVIDIA_TF32_OVERRIDE", "0")
    with pytest.raises(errors.UsageError) as caught:
        folders.claim(tmp_path, SMOKE, "demos-a")
    assert caught.value.argument == "the settings of jax" and "NVIDIA" in str(caught.value.got)


@pytest.mark.parametrize(("name", "argument"), [("source", "{}"), ("parts", "the version of {}")])
def test_weights_of_another_learner_are_refused(tmp_path, name, argument):
    claimed(tmp_path)
    recorded = files.read_json(tmp_path / "config.json")
    (learner,) = (part for part in recorded["source"] if part.startswith("learner"))
    recorded[name][learner] = 0
    files.write_json(tmp_path / "config.json", recorded)
    with mistakes.of(argument.format(learner)):
        folders.claim(tmp_path, SMOKE, "demos-a")


def test_weights_of_another_frozen_encoder_are_refused(tmp_path):
    claimed(tmp_path, "aaaa")
    folders.claim(tmp_path, SMOKE, "demos-a")  # trained by now: the encoder may be gone
    with mistakes.of("policy.encoder_weights", "bbbb") as caught:
        folders.claim(tmp_path, SMOKE, "demos-a", "bbbb")
    assert "aaaa" in caught.value.expected
    assert folders.read_config(tmp_path) == SMOKE


@pytest.mark.parametrize("parts", [{"eval": {"trials": 9}}, {"train": {"keep_checkpoints": 9}}])
def test_what_leaves_the_weights_alone_may_change(tmp_path, parts):
    claimed(tmp_path)
    folders.claim(tmp_path, changed(**parts), "demos-a")
    assert folders.read_config(tmp_path) == changed(**parts)


def test_a_folder_where_nothing_was_trained_takes_other_settings(tmp_path):
    folders.claim(tmp_path, SMOKE, "demos-a")
    (tmp_path / "checkpoints" / "@eaDir").mkdir(parents=True)  # a file system's own
    other = changed(train={"learning_rate": 1e-3})
    folders.claim(tmp_path, other, "demos-b", "bbbb")
    assert folders.read_config(tmp_path) == other
    folders.claim(tmp_path, other, "demos-b")
    assert "encoder" not in json.loads((tmp_path / "config.json").read_text())
    (tmp_path / "checkpoints" / "step_00000020").mkdir()
    with mistakes.of("train.learning_rate"):
        folders.claim(tmp_path, SMOKE, "demos-b", "bbbb")


@pytest.mark.parametrize("text", [None, "", '{"seed": 0', "[]", "{}", '{"newthing": 1}'])
def test_weights_whose_settings_are_gone_are_refused(tmp_path, text):
    """As any settings would do, and the result would tell of those."""
    claimed(tmp_path)
    path = tmp_path / "config.json"
    path.unlink() if text is None else path.write_text(text)
    with pytest.raises(errors.UsageError, match=re.escape(str(tmp_path))):
        folders.claim(tmp_path, SMOKE, "demos-a")
    with pytest.raises(errors.UsageError, match=re.escape(str(tmp_path))) as caught:
        folders.read_config(tmp_path)
    weights = tmp_path / "policy.safetensors"
    assert f"starjax evaluate --policy {weights} scores its weights" in str(caught.value)


@pytest.mark.parametrize(
    ("values", "name"),
    [
        ({"eval": {"time_limit_s": "4"}}, "EvalConfig.time_limit_s"),
        ({"seed": True}, "RunConfig.seed"),
        ({"eval": 3}, "EvalConfig"),
        ({"policy": {"unet_channels": [1, "2"]}}, "DiffusionConfig.unet_channels"),
        ({"policy": {"observation": "sound"}}, "PolicyConfig.observation"),
    ],
)
def test_settings_of_other_types_are_named(values, name):
    with pytest.raises(ValueError, match=f"^{name}: "):
        config_json.from_dict(config.RunConfig, values)


def test_an_evaluation_is_under_way_until_its_result_is_there(tmp_path):
    trials = tmp_path / "evaluation"
    trials.mkdir()
    for name in ("plan.json", "chunk_0000.npz"):
        assert not folders.is_under_way(tmp_path)
        (trials / name).touch()
    assert folders.is_under_way(tmp_path)
    (tmp_path / "result.json").touch()
    os.utime(trials / "plan.json", ns=(1, 1))
    assert not folders.is_under_way(tmp_path)
    (trials / "plan.json").touch()  # trials of a larger one
    os.utime(tmp_path / "result.json", ns=(1, 1))
    assert folders.is_under_way(tmp_path)


def test_settings_that_runs_differ_in_are_named():
    def values(**parts):
        return config_json.as_json(changed(**parts))

    old = values()
    del old["policy"]["trocar_yaw"]
    same = values(seed=5, train={"keep_checkpoints": 9}, eval={"trials": 9})
    assert (
        config_json.differing_settings([])
        == config_json.differing_settings([values(), old, same])
        == []
    )
    newer = values(policy={"trocar_yaw": "fixed"}, demos={"per_trocar": 9})
    newer["policy"]["unheard_of"] = 1
    found = config_json.differing_settings([old, newer])
    names = ["demos.per_trocar", "policy.trocar_yaw", "policy.unheard_of"]
    assert found == config_json.differing_settings([newer, old, newer]) == names


def test_a_methods_folder_is_found_from_within_and_told_from_others(tmp_path, monkeypatch):
    (tmp_path / "stardiff").mkdir()
    monkeypatch.chdir(tmp_path / "stardiff")
    assert folders.existing(".") == tmp_path / "stardiff"
    with pytest.raises(errors.UsageError, match=r"RUN: .*got \.\.; there is \.\./stardiff$"):
        folders.existing("..")
    (tmp_path / "policy.safetensors").touch()
    for name in ("..", "../policy.safetensors"):
        with pytest.raises(errors.UsageError, match=r"--policy \S*[^s]/policy.safetensors scores"):
            folders.existing(name)
    with pytest.raises(errors.UsageError, match=r"got nowhere$"):
        folders.existing("nowhere")


def test_a_damaged_record_of_times_starts_afresh_and_a_full_disk_hides_nothing(
    tmp_path, monkeypatch
):
    (tmp_path / "timings.json").write_text('{"train": 1')
    with stage_times.timed(tmp_path, "train"):
        pass
    assert stage_times.read(tmp_path)["train"] < 1

    def full(path, value):
        raise OSError("no room for timings.json")

    monkeypatch.setattr(stage_times.files, "write_json", full)
    with pytest.raises(OSError, match="checkpoint"), stage_times.timed(tmp_path, "train"):
        raise OSError("no room for the checkpoint")


def test_eight_methods_have_six_sets_of_weights(tmp_path):
    files = {folders.weights(tmp_path, name) for name in methods.TABLE_II}
    assert len(methods.TABLE_II) == 8 and len(files) == 6


def test_stardiff_single_is_dp_rcm4_and_nothing_else_is_a_twin():
    pairs = {
        name: folders.equivalent_methods(name)
        for name in methods.METHODS
        if folders.equivalent_methods(name)
    }
    assert pairs == {"dp_rcm4": ["stardiff_single"], "stardiff_single": ["dp_rcm4"]}


def test_a_twin_takes_over_the_evaluation_once(tmp_path):
    chunk = tmp_path / "dp_rcm4" / "evaluation" / "chunk_0000.npz"
    chunk.parent.mkdir(parents=True)
    chunk.write_bytes(b"first")
    folders.adopt_equivalent(tmp_path, "stardiff")
    folders.adopt_equivalent(tmp_path, "stardiff_single")
    taken = tmp_path / "stardiff_single" / "evaluation" / "chunk_0000.npz"
    assert taken.read_bytes() == b"first" and not (tmp_path / "stardiff").exists()
    chunk.write_bytes(b"second")
    folders.adopt_equivalent(tmp_path, "stardiff_single")
    assert taken.read_bytes() == b"first"


def test_a_twin_whose_trials_cannot_be_copied_is_left_out(tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    (tmp_path / "dp_rcm4" / "evaluation").mkdir(parents=True)
    (tmp_path / "dp_rcm4" / "evaluation" / "chunk_0000.npz").write_bytes(b"first")
    with monkeypatch.context() as patch, pytest.raises(files.StorageError, match="No space left"):
        patch.setattr(shutil, "copyfile", full)
        folders.adopt_equivalent(tmp_path, "stardiff_single")
    assert not any((tmp_path / "stardiff_single").iterdir())
    folders.adopt_equivalent(tmp_path, "stardiff_single")
    assert (tmp_path / "stardiff_single" / "evaluation" / "chunk_0000.npz").exists()


def test_a_linked_method_is_called_as_its_link(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    link = tmp_path / "stardiff"
    link.symlink_to(tmp_path / "elsewhere")
    assert folders.existing(str(link)) == link


def test_time_of_another_work_does_not_outlive_a_kill(tmp_path):
    (tmp_path / "timings.json").write_text(json.dumps({"x": 1.0, "x: compile": 1.0, "y": 2.0}))
    with stage_times.timed(tmp_path, "x", resumes=False):
        assert stage_times.read(tmp_path) == {"y": 2.0}  # a kill -9 here would leave this


def test_time_adds_up_over_starts_also_after_an_interruption(tmp_path):
    import jax

    unknown = time.time() % 1.0  # makes it a program that no cache holds: those are too quick
    (tmp_path / "timings.json").write_text(json.dumps({"train x": 100.0}))
    with pytest.raises(KeyboardInterrupt), stage_times.timed(tmp_path, "train x"):
        jax.block_until_ready(jax.jit(lambda x: jax.numpy.sort(x * unknown))(np.arange(8.0)))
        raise KeyboardInterrupt
    spent = stage_times.read(tmp_path)
    assert 100.0 < spent["train x"] < 160.0
    # Both are rounded to hundredths of a second.
    assert 0.0 < spent["train x: compile"] <= round(spent["train x"] - 100.0, 2)
    with stage_times.timed(tmp_path, "train x", resumes=False):  # nothing of the others is left
        pass
    assert stage_times.read(tmp_path)["train x"] < 60.0
