"""Stored programs: equal to the bit, and traced again after a change of sources or values."""

import hashlib
import importlib
import itertools
import os
import subprocess
import sys
import time
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax.runtime import files, package_files, stored, tree_json
from starjax.runtime.precompile import Program

# Its traces are counted in a global, as a closure would be part of the key.
PART = """
import flax.struct
import jax
import jax.numpy as jnp

TRACES = []


@flax.struct.dataclass
class State:
    key: object
    x: object
    unit: str = flax.struct.field(pytree_node=False, default="mm")


def half(x):
    return 0.5 * x


def with_keys(keys):
    def run(state, scale):
        TRACES.append(1)
        return state, {"sum": jnp.sum(jax.vmap(jax.random.normal)(keys)) * scale}

    return run


def steps(count, factor):
    def run(state, scale):
        TRACES.append(1)
        key, sub = jax.random.split(state.key)

        def body(i, x):
            return half(x) + scale * jax.random.normal(sub, x.shape)

        x = jax.lax.fori_loop(0, count, body, factor * state.x)
        return state.replace(key=key, x=x), {"sum": jnp.sum(x), "none": None}

    return run
"""
SCRIPT = """
import hashlib, sys
from starjax.runtime import prepare_xla
prepare_xla()
import jax, jax.numpy as jnp
import part
from starjax.runtime.precompile import Program

state = part.State(jax.random.key(0), jnp.arange(4.0))
state, _ = Program(part.steps(3, 2.0))(state, 0.5)
print(len(part.TRACES), hashlib.sha256(state.x.tobytes()).hexdigest())
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    place = tmp_path / "programs"
    monkeypatch.setattr(stored, "is_used", True)
    monkeypatch.setattr(stored, "_folder", lambda: place)
    return place


@pytest.fixture
def part(tmp_path, monkeypatch):
    (tmp_path / "part.py").write_text(PART)
    monkeypatch.setattr(package_files, "_started", time.time() + 3600)
    monkeypatch.syspath_prepend(tmp_path)
    yield importlib.import_module("part")
    del sys.modules["part"]
    forget_sources()


def forget_sources():
    """Reads all sources again, like a new process."""
    importlib.invalidate_caches()
    for function in (package_files._files, package_files._digest, stored._sources):
        function.cache_clear()


def call(part, function=None, state=None, scale: Any = 0.5):
    """Calls a program as a new process would; returns the traces that it took, and its result."""
    before = len(part.TRACES)
    state = state or part.State(jax.random.key(0), jnp.arange(4.0))
    result = Program(function or part.steps(3, 2.0))(state, scale)
    return len(part.TRACES) - before, result


def assert_equal(one, other):
    assert jax.tree.structure(one) == jax.tree.structure(other)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        assert a.dtype == b.dtype
        if jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
            a, b = jax.random.key_data(a), jax.random.key_data(b)
        np.testing.assert_array_equal(a, b)


def test_it_is_traced_once_and_equals_the_function_to_the_bit(folder, part):
    state = part.State(jax.random.key(0), jnp.arange(4.0))
    usual = jax.jit(part.steps(3, 2.0))(state, 0.5)
    (first, found), (again, read) = call(part), call(part)
    assert (first, again) == (1, 0)
    assert_equal(found, usual)
    assert_equal(read, usual)
    weak = Program(part.steps(3, 2.0))(state, 0.5)[1]["sum"].weak_type
    assert weak == usual[1]["sum"].weak_type


def test_any_change_is_traced_again(folder, part, tmp_path, monkeypatch):
    def with_unit():
        return part.State(jax.random.key(0), jnp.arange(4.0), unit="m")

    changes = {
        "closure": lambda: call(part, part.steps(4, 2.0)),
        "array": lambda: call(part, part.steps(3, np.array([1.0, 2.0, 3.0, 4.0]))),
        "key": lambda: call(part, part.steps(3, jax.random.uniform(jax.random.key(1)))),
        "keys": lambda: call(part, part.with_keys(jax.random.split(jax.random.key(2), 3))),
        "other keys": lambda: call(part, part.with_keys(jax.random.split(jax.random.key(3), 3))),
        "content of an array": lambda: call(part, part.steps(3, np.array([1.0, 2.0, 3.0, 5.0]))),
        "shape": lambda: call(part, state=part.State(jax.random.key(0), jnp.arange(5.0))),
        "type": lambda: call(part, state=part.State(jax.random.key(0), jnp.arange(4))),
        "weak type": lambda: call(part, scale=np.float32(0.5)),
        "constant of a node": lambda: call(part, state=with_unit()),
    }
    assert call(part)[0] == 1
    for name, change in changes.items():
        assert [change()[0] for _ in range(2)] == [1, 0], name
    with jax.default_matmul_precision("highest"):
        assert [call(part)[0] for _ in range(2)] == [1, 0]
    with monkeypatch.context() as patch:
        patch.setattr(jax.local_devices()[0].__class__, "device_kind", "another", raising=False)
        forget_sources()
        assert [call(part)[0] for _ in range(2)] == [1, 0]
    # A global's code, which is in no closure.
    (tmp_path / "part.py").write_text(PART.replace("0.5 * x", "0.6 * x"))
    forget_sources()
    edited = importlib.reload(part)
    assert [call(edited)[0] for _ in range(2)] == [1, 0]
    assert float(call(edited)[1][1]["sum"]) != float(call(edited, scale=0.4)[1][1]["sum"])


def test_an_edit_of_starjax_is_traced_again(folder, part, monkeypatch):
    assert call(part)[0] == 1
    usual = package_files._digest

    def edited(paths):
        return usual(paths) + "x" * any(path.name == "stored.py" for path in paths)

    edited.cache_clear = usual.cache_clear
    monkeypatch.setattr(package_files, "_digest", edited)
    stored._sources.cache_clear()
    assert [call(part)[0] for _ in range(2)] == [1, 0]


def test_an_edit_after_the_start_is_no_key(folder, part, monkeypatch):
    monkeypatch.setattr(package_files, "_started", time.time() - 3600)
    assert [call(part)[0] for _ in range(2)] == [1, 1]
    assert not folder.exists()


def test_packages_that_a_part_uses_count_and_installed_ones_do_not(tmp_path, monkeypatch):
    monkeypatch.setattr(package_files, "_started", time.time() + 3600)
    (tmp_path / "tool_part").mkdir()
    (tmp_path / "tool_part" / "__init__.py").write_text("from help_part import width\n")
    (tmp_path / "tool_part" / "tool.xml").write_text("<mujoco/>")
    (tmp_path / "help_part.py").write_text("import jax\ndef width(): return 1\n")
    monkeypatch.syspath_prepend(tmp_path)
    # As in a folder of `pip install --target`, with a stand-in for absent packages.
    target = tmp_path / "target"
    (target / "a_part-1.0.dist-info").mkdir(parents=True)
    stand_in = "class Absent:\n  def __getattribute__(self, name): raise ImportError\n"
    (target / "a_part.py").write_text(stand_in)
    with open(tmp_path / "help_part.py", "a") as file:
        file.write("import a_part\nabsent = a_part.Absent()\n")
    monkeypatch.syspath_prepend(target)
    importlib.import_module("tool_part")
    before = package_files.digests({"tool_part.sub", "jax._src.core", "os"})
    assert [*before] == ["help_part", "tool_part"]
    for file, text in {"help_part.py": "width = 2\n", "tool_part/tool.xml": "<other/>"}.items():
        (tmp_path / file).write_text(text)
        forget_sources()
        after = package_files.digests({"tool_part"})
        package = file.partition("/")[0].removesuffix(".py")
        assert after[package] != before[package]
    for name in ("tool_part", "help_part"):
        del sys.modules[name]
    forget_sources()
    with pytest.raises(package_files.Missing):
        package_files.digests({"tool_part_of_nobody"})


@pytest.mark.parametrize(
    "spoil",
    [
        lambda content: content[:200] + bytes([content[200] ^ 1]) + content[201:],
        lambda content: content[: len(content) // 2],
        lambda content: b"",
        lambda content: b"of another program\n" * 40,
    ],
)
def test_a_damaged_file_is_traced_again_and_replaced(folder, part, spoil):
    _, usual = call(part)
    (path,) = (path for path in folder.rglob("*") if path.is_file())
    content = path.read_bytes()
    path.write_bytes(spoil(content))
    assert_equal(call(part)[1], usual)
    assert path.read_bytes() == content
    assert call(part)[0] == 0


def test_a_folder_that_cannot_be_written_changes_nothing(folder, part, monkeypatch):
    _, usual = call(part)
    files.write_bytes(folder.parent / "file", b"")
    monkeypatch.setattr(stored, "_folder", lambda: folder.parent / "file" / "programs")
    for _ in range(2):
        traces, found = call(part)
        assert traces == 1
        assert_equal(found, usual)


def test_what_cannot_be_read_or_exported_is_traced_anew(folder, part, capsys):
    class Opaque:
        scale = 2.0

    opaque = Opaque()
    script = eval("lambda x: 2.0 * x", {"__name__": "__main__"})

    def calls_host(x):
        return jax.pure_callback(lambda y: 2.0 * y, jax.ShapeDtypeStruct(x.shape, x.dtype), x)

    with jax.explain_cache_misses(True):
        for function in (lambda x: opaque.scale * x, script, calls_host):
            assert Program(function)(jnp.ones(2)).tolist() == [2.0, 2.0]
    assert not [*folder.rglob("*")]
    assert capsys.readouterr().err.count(" is traced: ") >= 3


def test_donated_arguments_are_given_away(folder, part):
    for _ in range(2):
        state = part.State(jax.random.key(0), jnp.arange(4.0))
        Program(part.steps(3, 2.0), donate_argnums=0)(state, 0.5)
        assert state.x.is_deleted() and state.key.is_deleted()
    assert len(part.TRACES) == 1


def test_results_are_arguments_of_the_same_executable(folder, part):
    program = Program(part.steps(3, 2.0))
    state = jax.device_put(part.State(jax.random.key(0), jnp.arange(4.0)), jax.devices()[0])
    for _ in range(3):
        state, _ = program(state, 0.5)
    assert program._function._cache_size() == 1


def test_several_devices_and_tracers_are_traced_anew(folder, part):
    state = part.State(jax.random.key(0), jnp.arange(4.0))
    program = Program(part.steps(3, 2.0))
    jax.eval_shape(program, state, 0.5)
    mesh = jax.sharding.Mesh(np.array([jax.devices()[0]] * 1), ("x",))
    split = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("x"))
    assert not folder.exists()
    shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=split), state.x)
    assert stored._device((shapes,)) == jax.devices()[0]
    two = type("Two", (), {"sharding": type("S", (), {"device_set": {1, 2}})()})()
    assert stored._device((two,)) is None


def test_folders_of_the_oldest_sources_go(folder, part, monkeypatch):
    with monkeypatch.context() as patch:
        for i in range(stored.KEPT + 2):
            patch.setattr(stored, "_sources", lambda device, i=i: f"sources{i}")
            assert call(part)[0] == 1
        assert len([*folder.iterdir()]) == stored.KEPT
        assert call(part)[0] == 0


def test_processes_share_programs_also_at_once(part, tmp_path):
    (tmp_path / "script.py").write_text(SCRIPT)
    env = {"STARJAX_CACHE": str(tmp_path / "cache"), "PYTHONPATH": str(tmp_path)}
    command = [sys.executable, str(tmp_path / "script.py")]

    def begin():
        return subprocess.Popen(
            command, env={**os.environ, **env}, stdout=subprocess.PIPE, text=True
        )

    together = [begin(), begin()]
    found = [process.communicate()[0].split() for process in together]
    traces, later = begin().communicate()[0].split()
    assert traces == "0"
    state = part.State(jax.random.key(0), jnp.arange(4.0))
    usual = jax.jit(part.steps(3, 2.0))(state, 0.5)[0].x
    assert {later, *(digest for _, digest in found)} == {
        hashlib.sha256(usual.tobytes()).hexdigest()
    }


@flax.struct.dataclass
class Node:
    x: object
    unit: object = flax.struct.field(pytree_node=False, default="mm")


def test_trees_survive_json():
    part = importlib.import_module("starjax.core.types").Pose(1, (2, [3, None]))
    for tree in (part, Node({"b": 1, "a": ()}, "m"), [], 1, None, {"n": Node(Node(1))}):
        structure = jax.tree.structure(tree)
        assert tree_json.decode(tree_json.encode(structure)) == structure
    for tree in ({1: 2}, Node(1, ("m",)), jax.tree_util.Partial(max, 1)):
        with pytest.raises(TypeError):
            tree_json.encode(jax.tree.structure(tree))


def test_order_and_kind_of_values_count():
    of = stored.fingerprint.of
    values = [
        (1, 2), (2, 1), [1, 2], {"a": 1}, {"b": 1}, 1, 1.0, True, "1", None, slice(1, 2), {1, 2},
        np.float32(1), np.float64(1), np.zeros(2), np.zeros((2, 1)), jax.random.key(1),
        jax.random.key(2), len, max, Node, Node(1), Node(1, "m"), lambda: 1, lambda: 2,
    ]  # fmt: skip
    digests = [of(value)[0] for value in values]
    for (i, one), (j, other) in itertools.combinations(enumerate(digests), 2):
        assert one != other, (values[i], values[j])
    assert [of(value)[0] for value in values] == digests
