"""XLA is prepared once, for the jaxlib at hand, without taking anything from the user."""

import importlib
import os
import subprocess
import sys
import textwrap
import threading
from pathlib import Path

import pytest

from starjax.runtime import gpu, jax_start, xla

SMALLEST = "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"
FLAG = "--xla_cpu_use_fusion_emitters=false"


def _prepared(monkeypatch, tmp_path, version, **environment):
    for name in ("XLA_FLAGS", "JAX_COMPILATION_CACHE_DIR", SMALLEST):
        monkeypatch.setenv(name, "")  # restores it, also if it was unset
        monkeypatch.delenv(name)
    monkeypatch.setenv("STARJAX_CACHE", str(tmp_path))
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(xla, "_jaxlib_version", lambda: version)
    monkeypatch.delitem(sys.modules, "jax", raising=False)
    xla.prepare_xla()
    return os.environ.get("XLA_FLAGS", ""), os.environ.get("JAX_COMPILATION_CACHE_DIR")


def test_the_flag_is_only_for_old_jaxlib(monkeypatch, tmp_path):
    assert _prepared(monkeypatch, tmp_path, (0, 10))[0] == FLAG
    assert _prepared(monkeypatch, tmp_path, (0, 11))[0] == ""


def test_programs_that_simulate_nothing_get_back_what_it_turns_off(monkeypatch):
    monkeypatch.setattr(xla, "_jaxlib_version", lambda: (0, 10))
    assert xla.options_without_kinematics() == {FLAG.split("=")[0].lstrip("-"): True}
    monkeypatch.setattr(xla, "_jaxlib_version", lambda: (0, 11))
    assert xla.options_without_kinematics() == {}


@pytest.mark.parametrize("started", [False, True])
def test_a_program_in_which_jax_has_started_is_told_that_the_flag_comes_too_late(started):
    code = "import jax; from starjax.runtime import xla; xla._jaxlib_version = lambda: (0, 10);"
    code += "jax.numpy.ones(1);" * started + "xla.prepare_xla()"
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env=_env(), capture_output=True, text=True, check=True)
    assert done.stderr.count("prepare_xla") == started


def test_the_users_flags_stay_and_win(monkeypatch, tmp_path):
    flags, _ = _prepared(monkeypatch, tmp_path, (0, 10), XLA_FLAGS="--a=1")
    assert flags == f"--a=1 {FLAG}"
    own = "--xla_cpu_use_fusion_emitters=true"
    assert _prepared(monkeypatch, tmp_path, (0, 10), XLA_FLAGS=own)[0] == own


def test_the_cache_is_on_unless_the_user_chose_one(monkeypatch, tmp_path):
    assert str(tmp_path) in _prepared(monkeypatch, tmp_path, (0, 10))[1]
    chosen = _prepared(monkeypatch, tmp_path, (0, 10), JAX_COMPILATION_CACHE_DIR="/x")[1]
    assert chosen == "/x"


def test_small_programs_are_kept_unless_the_user_set_a_time(monkeypatch, tmp_path):
    _prepared(monkeypatch, tmp_path, (0, 10))
    assert float(os.environ[SMALLEST]) == 0
    _prepared(monkeypatch, tmp_path, (0, 10), **{SMALLEST: "2"})
    assert os.environ[SMALLEST] == "2"


def test_no_cache_where_none_can_be_made(monkeypatch, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert _prepared(monkeypatch, tmp_path / "file", (0, 10))[1] is None
    assert capsys.readouterr().err.count("no cache") == 1


def test_who_has_no_home_has_a_cache_too(monkeypatch):
    def homeless():
        raise RuntimeError("Could not determine home directory.")

    for name in ("STARJAX_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(xla.Path, "home", homeless)
    assert xla.cache_directory().name.startswith("starjax-")


def test_a_platform_that_jax_cannot_use_is_a_mistake():
    code = """
        import sys
        from starjax import cli
        from starjax.runtime import jax_start, xla
        xla.prepare_xla()
        sys.exit(cli.guard(lambda argv: jax_start.require_devices("starjax.sim.env"), []))
    """
    for name in ("nonsense",) if gpu.has_plugin() else ("nonsense", "cuda"):
        environment = {**_env(), "JAX_PLATFORMS": name}
        command = [sys.executable, "-c", textwrap.dedent(code)]
        found = subprocess.run(command, capture_output=True, text=True, env=environment)
        assert found.returncode == 2 and "JAX_PLATFORMS: expected" in found.stderr, found.stderr
        assert name in found.stderr and "Traceback" not in found.stderr


def _container(monkeypatch, tmp_path, line, group, names, values):
    """A process whose control group has this limit, use, and cache in use, in GB."""
    folder = tmp_path / "groups" / group
    folder.mkdir(parents=True)
    limit, used, cached = (str(value) if value == "max" else str(value << 30) for value in values)
    (folder / names[0]).write_text(f"{limit}\n")
    (folder / names[1]).write_text(f"{used}\n")
    (folder / "memory.stat").write_text(f"anon 5\n{names[2]} {cached}\n")
    (tmp_path / "self").write_text(f"2:cpu:/\n{line}\n")
    monkeypatch.setattr(xla, "_GROUPS", tmp_path / "groups")
    monkeypatch.setattr(xla, "_GROUPS_OF_THIS", tmp_path / "self")
    monkeypatch.setattr(xla, "_physical_bytes", lambda: 64 << 30)
    monkeypatch.setattr(xla, "_free_bytes", lambda: 32 << 30)
    return xla.memory_bytes() >> 30, xla.available_bytes() >> 30


_V1 = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
_V2 = ("memory.max", "memory.current", "inactive_file")


@pytest.mark.parametrize(
    ("line", "group", "names", "values", "wanted"),
    [
        ("0::/job/step", "job/step", _V2, (8, 5, 1), (8, 4)),
        ("0::/job/step", "job", _V2, (8, 5, 1), (8, 4)),  # the limit of a parent counts
        ("0::/", "", _V2, (8, 9, 0), (8, 0)),
        ("0::/job", "job", _V2, ("max", 5, 1), (64, 32)),
        ("0::/job", "job", _V2, (60, 5, 1), (60, 32)),  # the machine has less
        ("0::/job", "elsewhere", _V2, (8, 5, 1), (64, 32)),
        ("3:hugetlb,memory:/job", "memory/job", _V1, (8, 5, 1), (8, 4)),
        ("3:memory:/outside/job", "memory", _V1, (8, 5, 1), (8, 4)),  # seen from in the container
        ("3:memory:/job", "memory/job", _V1, (1 << 33, 5, 1), (64, 32)),
    ],
)
def test_the_limit_of_a_container_counts(monkeypatch, tmp_path, line, group, names, values, wanted):
    assert _container(monkeypatch, tmp_path, line, group, names, values) == wanted


def test_no_control_groups_no_limit(monkeypatch, tmp_path):
    monkeypatch.setattr(xla, "_GROUPS_OF_THIS", tmp_path / "none")
    assert xla.memory_bytes() == xla._physical_bytes()


def test_jax_is_not_imported():
    code = "import sys, starjax.runtime as r; r.prepare_xla(); r.xla.hardware(); r.xla.versions();"
    code += "assert 'jax' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, env=_env())


def test_jax_accepts_what_is_set(tmp_path):
    code = "import starjax.runtime as r; r.prepare_xla(); import jax; jax.numpy.ones(3).sum();"
    code += "h = r.xla.hardware(); assert h['backend'] == 'cpu' and h['memory_gb'] > 0"
    subprocess.run([sys.executable, "-c", code], check=True, env=_env(STARJAX_CACHE=str(tmp_path)))
    assert any(file.is_file() for file in tmp_path.rglob("*")), "the program was not kept"


def _env(**more):
    own = ("XLA_FLAGS", "JAX_PLATFORMS", "JAX_COMPILATION_CACHE_DIR", SMALLEST)
    env = {k: v for k, v in os.environ.items() if k not in own}
    return {**env, "PYTHONPATH": os.pathsep.join(sys.path), "JAX_PLATFORMS": "cpu", **more}


def test_modules_are_imported_while_jax_starts(monkeypatch):
    begun, imported, seen = threading.Event(), threading.Event(), []

    def start():
        begun.set()
        assert imported.wait(10)
        return []

    def import_module(name):
        assert begun.wait(10)
        seen.append(name)
        imported.set()

    monkeypatch.setattr("jax.local_devices", start)
    monkeypatch.setattr(importlib, "import_module", import_module)
    jax_start.require_devices("somewhere.there")
    assert seen == ["somewhere.there"]


def test_a_start_takes_the_memory_of_each_device_unless_it_is_full(monkeypatch):
    asked = []

    def put(value, device):
        asked.append(device)
        raise RuntimeError("RESOURCE_EXHAUSTED")

    monkeypatch.setattr("jax.device_put", put)
    monkeypatch.setattr("jax.local_devices", lambda: ["first", "second"])
    jax_start.require_devices()
    assert asked == ["first", "second"]


def test_a_tilde_in_the_cache_is_the_home_folder(monkeypatch):
    monkeypatch.setenv("HOME", "/users/me")
    monkeypatch.setenv("STARJAX_CACHE", "~/cache")
    assert xla.cache_directory() == Path("/users/me/cache")
