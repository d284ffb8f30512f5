"""No setting of jax mixes results: each is set by commands, recorded, or changes no number."""

import importlib.util
import json
import os
import pathlib
import subprocess
import sys
import textwrap

import jax
import pytest
import stubs

from starjax.data import schema, store
from starjax.runtime import jax_settings

JOBS = pathlib.Path(__file__).parents[1] / "evaluation" / "test_evaluate.py"  # digest of stubs

# A value other than jax's own of every setting that commands set.
OTHERS = {
    "jax_default_prng_impl": "unsafe_rbg",
    "jax_explicit_x64_dtypes": "error",
    "jax_random_seed_offset": 1,
    "jax_array_garbage_collection_guard": "log",
    "jax_error_checking_behavior_divide": "raise",
    "jax_error_checking_behavior_nan": "raise",
    "jax_error_checking_behavior_oob": "raise",
    "jax_legacy_prng_key": "error",
    "jax_numpy_dtype_promotion": "strict",
    "jax_numpy_rank_promotion": "raise",
    "jax_transfer_guard": "disallow",
    "jax_transfer_guard_device_to_device": "disallow",
    "jax_transfer_guard_device_to_host": "disallow",
    "jax_transfer_guard_host_to_device": "disallow",
}
SET = {**jax_settings.FIXED, **jax_settings.CHECKS}
for name, usual in SET.items():
    OTHERS.setdefault(name, not usual)


def job():
    """`run` and `job` of the tests of rollouts."""
    spec = importlib.util.spec_from_file_location("rollout_jobs", JOBS)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def changed(monkeypatch):
    """Sets settings of jax, or variables of the environment, until the end of the test."""
    before = {}

    def change(name, value):
        if name not in jax.config.values:
            return monkeypatch.setenv(name, value)
        before.setdefault(name, jax.config.values[name])
        return jax.config.update(name, value)

    yield change
    for name, value in before.items():
        jax.config.update(name, value)


def test_nothing_is_recorded_where_all_is_as_usual():
    assert jax_settings.recorded() == {} and jax_settings.record() == {}


def test_commands_set_them_as_always(changed):
    for name in sorted(SET, reverse=True):  # one transfer guard also sets the three others
        changed(name, OTHERS[name])
    assert jax_settings.recorded().keys() == jax_settings.FIXED.keys()
    assert set(jax_settings.fix()) == set(SET) and jax_settings.fix() == []
    assert jax_settings.recorded() == {}


RECORDED = [
    ("jax_default_matmul_precision", "highest", {"jax_default_matmul_precision": "highest"}),
    ("jax_disable_most_optimizations", True, {"jax_disable_most_optimizations": "True"}),
    ("NVIDIA_TF32_OVERRIDE", "0", {"NVIDIA_TF32_OVERRIDE": "0"}),
    ("XLA_FLAGS", "--xla_cpu_enable_fast_math", {"--xla_cpu_enable_fast_math": "true"}),
    ("XLA_FLAGS", "--xla_a=1 --xla_a=2", {"--xla_a": "2"}),
    ("LIBTPU_INIT_ARGS", "--xla_b=1", {"--xla_b": "1"}),
    ("XLA_FLAGS", "--xla_dump_to=here --xla_force_host_platform_device_count=2", {}),
]


@pytest.mark.parametrize(("name", "value", "found"), RECORDED)
def test_what_stays_the_users_is_recorded(name, value, found, changed):
    usual = os.environ.get("XLA_FLAGS", "") if name == "XLA_FLAGS" else ""
    changed(name, f"{usual} {value}" if usual else value)
    assert jax_settings.fix() == [] and jax_settings.recorded() == found


def test_flags_in_a_file_are_flags(changed, tmp_path):
    file = tmp_path / "flags"
    file.write_text(f"{os.environ.get('XLA_FLAGS', '')}\n--xla_a=1\n")
    changed("XLA_FLAGS", str(file))
    assert jax_settings.recorded() == {"--xla_a": "1"}


def test_a_command_scores_the_same_trials_whatever_the_environment_says(tmp_path):
    """All settings that change random numbers, types or errors at once, of another project."""
    job().job(tmp_path / "usual")
    code = f"""
        import importlib.util, pathlib, sys
        from starjax.runtime import jax_start, xla

        xla.prepare_xla()
        jax_start.require_devices()
        spec = importlib.util.spec_from_file_location("jobs", {str(JOBS)!r})
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        module.job(pathlib.Path(sys.argv[1]))
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code), str(tmp_path / "other")],
        env={
            **os.environ,
            **{name.upper(): str(value) for name, value in OTHERS.items()},
            "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
        },
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    usual, other = (tmp_path / name / "trials.json" for name in ("usual", "other"))
    assert json.loads(other.read_text()) == json.loads(usual.read_text())
    said = [line for line in done.stderr.splitlines() if line.startswith("starjax: ")]
    assert len(said) == 1 and all(name.upper() in said[0] for name in SET)


@pytest.mark.parametrize(
    ("name", "value", "draws_others"),
    [
        ("jax_threefry_partitionable", False, True),
        ("jax_random_seed_offset", 1, True),
        ("jax_default_matmul_precision", "highest", False),
    ],
)
def test_a_program_with_other_settings_mixes_no_trials(
    name, value, draws_others, changed, tmp_path
):
    """As after a kill: half of the chunks exist, made with the usual settings."""
    run = job().run
    usual = run(tmp_path / "mixed", chunk=3)
    (tmp_path / "mixed" / "chunk_0001.npz").unlink()
    changed(name, value)
    replaced = []
    mixed = run(tmp_path / "mixed", chunk=3, report=replaced.append)
    whole = run(tmp_path / "whole", chunk=3)
    assert len(replaced) == 1 and "another evaluation" in replaced[0]
    plan = json.loads((tmp_path / "mixed" / "plan.json").read_text())
    assert plan["jax_settings"] == {name: str(value)}
    assert (mixed.steps == whole.steps).all() and (
        mixed.labels["source"] == whole.labels["source"]
    ).all()
    assert (mixed.labels["source"] != usual.labels["source"]).any() == draws_others


def test_demonstrations_of_other_settings_are_another_dataset(changed):
    def named():
        wanted = schema.DemoSettings(per_trocar=1, seed=0, max_steps=9)
        return store.digest(schema.describe(stubs.make_env(), stubs.trocars(0, 4), wanted))

    usual = named()
    changed("jax_random_seed_offset", 1)
    assert named() != usual
    jax_settings.fix()
    assert named() == usual
    changed("jax_default_matmul_precision", "highest")
    assert named() != usual
