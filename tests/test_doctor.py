"""The doctor finds planted faults, and gives each one remedy."""

import errno
import fcntl
import importlib.metadata
import os
import subprocess
import sys

import pytest

from starjax.cli import doctor
from starjax.runtime import gpu


def faults(findings):
    return [finding for finding in findings if finding.remedy]


def test_a_sound_installation_has_no_fault():
    assert not faults(doctor.packages() + doctor.xla_flags() + doctor.devices() + doctor.scene())


def test_flag_that_aborts_jaxlib_is_found(monkeypatch):
    monkeypatch.setattr(importlib.metadata, "version", lambda name: "0.11.2")
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_use_fusion_emitters=false")
    (fault,) = faults(doctor.xla_flags())
    assert "take it out" in fault.remedy


@pytest.mark.parametrize(
    ("value", "slow"), [("=true", 1), ("=1", 1), ("", 1), ("=false", 0), ("=False", 0), ("=0", 0)]
)
def test_flag_that_slows_physics_is_found(monkeypatch, value, slow):
    monkeypatch.setattr(importlib.metadata, "version", lambda name: "0.10.2")
    monkeypatch.setenv("XLA_FLAGS", f"--xla_cpu_use_fusion_emitters{value}")
    assert len(faults(doctor.xla_flags())) == slow


def test_versions_that_do_not_fit_are_found(monkeypatch):
    found = {"jax": "0.10.2", "jaxlib": "0.10.1", "mujoco": "4.0.0", "mujoco-mjx": "3.17.0"}
    monkeypatch.setattr(doctor.xla, "versions", lambda: found)
    (fault,) = faults(doctor.packages())
    assert "jaxlib==0.10.2" in fault.remedy and fault.name == "packages"  # ends the search
    found["jax"] = found["jaxlib"] = "0.12.0"
    assert "untested" in faults(doctor.packages())[0].remedy
    del found["mujoco"]
    assert "mujoco not installed" in faults(doctor.packages())[0].remedy


def test_what_is_not_installed_ends_the_search_before_it_is_needed(monkeypatch, capsys):
    def absent(name):
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "version", absent)
    monkeypatch.setattr(doctor, "devices", lambda: pytest.fail("jax was asked"))
    assert doctor.main([]) == 1
    said = capsys.readouterr().out
    assert "jax, jaxlib, mujoco, mujoco-mjx not installed" in said and "skipped" in said


def test_a_folder_that_is_gone_is_a_fault(tmp_path, monkeypatch):
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    (fault,) = faults(doctor.storage())
    assert fault.name == "folder"


@pytest.mark.parametrize("error", ["RuntimeError", "ImportError"])
def test_a_jax_that_refuses_its_jaxlib_is_a_fault(tmp_path, error):
    (tmp_path / "jax.py").write_text(f"raise {error}('jaxlib is too old\\nfor this jax')")
    path = os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])])
    done = subprocess.run(
        [sys.executable, "-m", "starjax", "doctor"],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": path},
    )
    assert done.returncode == 1 and not done.stderr
    assert "jaxlib is too old\n       -> reinstall jax and jaxlib\n" in done.stdout
    assert "scene     jaxlib is too old\n" in done.stdout


def test_a_missing_encoder_is_found(monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    (fault,) = faults(doctor.video())
    assert fault.remedy == "pip install imageio-ffmpeg"
    monkeypatch.undo()
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", "/nonexistent")
    assert faults(doctor.video())


def test_unwritable_cache_and_little_memory_are_found(monkeypatch, tmp_path):
    (tmp_path / "file").touch()
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    monkeypatch.setenv("STARJAX_CACHE", str(tmp_path / "file" / "below"))
    assert any("STARJAX_CACHE" in fault.remedy for fault in faults(doctor.storage()))
    monkeypatch.setenv("STARJAX_CACHE", str(tmp_path))
    monkeypatch.setattr(doctor, "NEEDED_DISK", 1e18)
    folder, *caches = (fault.remedy for fault in faults(doctor.storage()))
    assert folder.endswith("by --out") and all("by STARJAX_CACHE" in cache for cache in caches)
    monkeypatch.setattr(doctor, "NEEDED_MEMORY", 1e15)
    assert faults(doctor.memory())


def test_a_cache_of_compiled_programs_that_takes_none_is_found(monkeypatch):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "/proc/self/task")  # there, not even for root
    (fault,) = faults(doctor.storage())
    assert fault.name == "programs" and "JAX_COMPILATION_CACHE_DIR" in fault.remedy
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "gs://a/b")  # jax alone can tell
    assert not faults(doctor.storage())


@pytest.mark.parametrize(("name", "broken"), [("ENOLCK", 0), ("EIO", 1)])
def test_locks_are_tried(monkeypatch, tmp_path, name, broken):
    def refuse(*_):
        raise OSError(getattr(errno, name), "flock")

    monkeypatch.chdir(tmp_path)
    assert doctor.folder_locks() == [doctor.Finding("locks", "the file system's")]
    monkeypatch.setattr(fcntl, "flock", refuse)
    (found,) = doctor.folder_locks()
    assert bool(found.remedy) == broken and not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("environment", "plugin", "remedy"),
    [
        ({}, False, "cuda"),
        ({}, True, "nvidia-smi"),  # its driver is too old, or the plugin fails
        ({"JAX_PLATFORM_NAME": "cpu"}, True, None),
    ],
)
def test_a_gpu_that_jax_does_not_use_is_found(monkeypatch, environment, plugin, remedy):
    for name in ("JAX_PLATFORMS", "JAX_PLATFORM_NAME", "CUDA_VISIBLE_DEVICES"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(gpu, "is_shown", lambda: True)
    monkeypatch.setattr(gpu, "has_plugin", lambda: plugin)
    monkeypatch.setattr(gpu, "is_used", lambda: False)
    findings = doctor.devices()
    assert [remedy in fault.remedy for fault in faults(findings)] == [True] * (remedy is not None)
    (preset,) = (finding.value for finding in findings if finding.name == "preset")
    assert "auto means cpu" in preset and "not on the GPU" in preset


def test_a_missing_scene_is_found(monkeypatch):
    from starjax.sim import assets

    def absent(name):
        raise FileNotFoundError("MJCF part 'x' is not there")

    monkeypatch.setattr(assets, "path", absent)
    assert faults(doctor.scene())


def test_exit_code_and_one_remedy_a_fault(monkeypatch, capsys):
    bad = [doctor.Finding("disk", "full", "make room")]
    for name in (
        "packages",
        "xla_flags",
        "storage",
        "folder_locks",
        "memory",
        "devices",
        "scene",
        "video",
    ):
        monkeypatch.setattr(doctor, name, lambda: [])
    assert doctor.main([]) == 0
    monkeypatch.setattr(doctor, "storage", lambda: bad)
    assert doctor.main([]) == 1
    assert capsys.readouterr().out.count("-> make room") == 1
