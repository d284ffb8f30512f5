"""The first line of a command comes before jax, which takes seconds to start."""

import subprocess
import sys

import starjax
from starjax.runtime import jax_start

COMMANDS = [
    "run",
    "run --preset smoke",
    "evaluate --policy compact",
    "sweep --policy compact",
    "stress --policy compact",
    "six-blocks",
    "calibrate --out x.safetensors",
    "serve",
    "pack compact x.safetensors",
    "find-mount fr5 grasper board",
    "view",
    "teleop",
]
PROGRAM = """
import sys
from starjax import cli
from starjax.runtime import jax_start

class Jax(BaseException):
    pass

class Finder:
    def find_spec(self, name, *rest):
        if name == "jax":
            raise Jax

sys.meta_path.insert(0, Finder())
sys.stderr = sys.stdout
for typed in sys.argv[1:]:
    print("$", typed)
    jax_start.announce_start.cache_clear()
    try:
        cli.dispatch(typed.split())
    except Jax:
        print("jax")
"""


def test_a_command_prints_a_line_before_it_imports_jax(tmp_path):
    command = [sys.executable, "-c", PROGRAM, *COMMANDS]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=True)
    shown = [part.splitlines() for part in done.stdout.split("$ ")[1:]]
    assert [typed for typed, *_ in shown] == COMMANDS
    for _, first, *rest in shown:
        assert first.startswith(f"starjax {starjax.__version__}: ") and rest[-1] == "jax"


def test_only_the_first_process_of_several_prints_it(monkeypatch, capsys):
    for variable in ("JAX_PROCESS_ID", "SLURM_PROCID"):
        monkeypatch.setenv(variable, "1")
        jax_start.announce("x")
        assert capsys.readouterr().err == ""
        monkeypatch.setenv(variable, "0")
    jax_start.announce("x")
    assert capsys.readouterr().err.count("\n") == 1
