"""Two processes that train together are one run, interrupted and resumed or not."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from starjax import config
from starjax.training import checkpoint, loop, processes

sys.path.insert(0, str(Path(__file__).parent))
import jobs  # it lies beside this file, for processes to run


def run_two(folder: Path, asks: int) -> list[str]:
    """What two processes print that train in `folder`."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    command = [sys.executable, str(Path(jobs.__file__)), "process", str(folder), str(asks)]
    started = []
    for index in range(2):
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
            "JAX_COORDINATOR_ADDRESS": f"localhost:{port}",
            "JAX_NUM_PROCESSES": "2",
            "JAX_PROCESS_ID": str(index),
        }
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        started.append(subprocess.Popen(command, env=environment, **pipes))
    said = [process.communicate(timeout=300) for process in started]
    assert [process.returncode for process in started] == [0, 0], said
    return [out for out, _ in said]


def test_two_processes_are_one_run(tmp_path, monkeypatch):
    stopped = run_two(tmp_path, asks=3)
    assert all("same command goes on" in line for line in stopped)
    assert 0 < checkpoint.steps(tmp_path / "run/checkpoints")[-1] < jobs.SETTINGS.steps
    run_two(tmp_path, asks=0)
    first, second = (dict(np.load(tmp_path / name)) for name in ("found.npz", "found-1.npz"))
    monkeypatch.setattr(loop.policies, "make", lambda *_: jobs._quadratic_policy())
    jobs.save(tmp_path / "alone.npz", jobs.train(tmp_path / "alone").state)
    for name, alone in np.load(tmp_path / "alone.npz").items():
        np.testing.assert_array_equal(first[name], second[name])
        np.testing.assert_allclose(first[name], alone, rtol=1e-5, atol=1e-6)
    assert (tmp_path / "run/metrics.jsonl").exists()


def test_half_of_the_variables_is_a_mistake(monkeypatch):
    monkeypatch.setenv("JAX_COORDINATOR_ADDRESS", "localhost:1")
    monkeypatch.setenv("JAX_NUM_PROCESSES", "2")
    monkeypatch.delenv("JAX_PROCESS_ID", raising=False)
    with pytest.raises(config.UsageError, match="JAX_PROCESS_ID: expected all or none"):
        processes.join()


@pytest.mark.parametrize(
    ("address", "count", "index", "word"),
    [
        ("", "2", "", "all or none"),
        ("", "", "1", "all or none"),
        ("localhost:1", "2", "2", "0 to 1"),
    ],
)
def test_variables_that_cannot_be_are_a_mistake(monkeypatch, address, count, index, word):
    for name, value in zip(processes._VARIABLES, (address, count, index), strict=True):
        monkeypatch.setenv(name, value)
    with pytest.raises(config.UsageError, match=word):
        processes.join()


def test_one_process_agrees_with_itself():
    assert processes.agree(False, 7) == (False, 7)
    assert processes.is_first() and processes.own_name("metrics.jsonl") == "metrics.jsonl"
