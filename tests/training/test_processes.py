"""Two processes that train together are one run, interrupted and resumed or not."""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import fakes
import jax
import mistakes
import numpy as np
import pytest
import several

from starjax.cli import pipeline
from starjax.core import config
from starjax.data import store
from starjax.evaluation import result
from starjax.runtime import processes
from starjax.training import batches, checkpoint, log, loop

sys.path.insert(0, str(Path(__file__).parent))
import jobs  # in this folder, for processes to run
import test_batches


def start_two(*words: str) -> list[subprocess.Popen]:
    """Two processes of one run, of what these words ask of `jobs`."""
    return several.start(jobs.__file__, *words)


def run_two(folder: Path, asks: int) -> list[str]:
    """What two processes print that train in `folder`."""
    started = start_two("process", str(folder), str(asks))
    said = [process.communicate(timeout=300) for process in started]
    assert [process.returncode for process in started] == [0, 0], said
    return [out for out, _ in said]


def test_two_processes_are_one_run(tmp_path, monkeypatch):
    stopped = run_two(tmp_path, asks=3)
    assert all("same command resumes" in line for line in stopped)
    assert 0 < checkpoint.steps(tmp_path / "run/checkpoints")[-1] < jobs.SETTINGS.steps
    run_two(tmp_path, asks=0)
    first, second = (dict(np.load(tmp_path / name)) for name in ("found-0.npz", "found-1.npz"))
    monkeypatch.setattr(loop.policies, "make", lambda *_: jobs._quadratic_policy())
    jobs.save(tmp_path / "alone.npz", jobs.train(tmp_path / "alone").state)
    for name, alone in np.load(tmp_path / "alone.npz").items():
        np.testing.assert_array_equal(first[name], second[name])
        np.testing.assert_allclose(first[name], alone, rtol=1e-5, atol=1e-6)
    written = {path.name for path in (tmp_path / "run").iterdir()}
    assert written == {"checkpoints", "metrics.jsonl"}
    logs = [log.read(tmp_path / name / "metrics.jsonl") for name in ("run", "alone")]
    ours, theirs = ([(line["step"], line["kind"]) for line in lines] for lines in logs)
    assert ours == theirs  # the log of the first process alone


def test_a_process_reads_its_share_of_a_streamed_batch(tmp_path):
    several.finish(start_two("feed", str(tmp_path)))
    own = [dict(np.load(tmp_path / f"feed-{i}.npz")) for i in range(2)]
    assert [int(one["gathered"]) for one in own] == [8, 8]
    np.testing.assert_array_equal(np.concatenate([one["rows"] for one in own]), np.arange(16))
    dataset = jax.tree.map(np.asarray, fakes.dataset(seed=0, demos=2, length=20))
    stream = batches.gathered(test_batches.SETUP, dataset, np.arange(40), jax.random.key(3), 0)
    alone = np.asarray(next(stream).observation.pose.p)
    stream.close()
    # The demonstrations of the two processes differ in last bits.
    np.testing.assert_allclose(np.concatenate([one["tips"] for one in own]), alone, atol=1e-7)


def test_the_whole_of_a_run_is_done_together(tmp_path):
    started = start_two("whole", str(tmp_path))
    found = several.finish(started)
    assert [process.returncode for process in started] == [0, 0], found
    assert "[1/4]" in found[0][0] and "[1/4]" not in found[1][0]  # the first one speaks
    made = result.read(tmp_path / "stardiff/result.json")
    assert len(made.trials) == 24 and made.scene.task == "reach"
    assert made.dataset_digest and not list(tmp_path.rglob(".shared"))
    assert len(store.keys(next(tmp_path.glob("demos-*")))) >= 6


def stop_two(
    started: list[subprocess.Popen],
    begun: Callable[[], bool],
    number: int,
    told: tuple[int, ...] = (1, 0),
) -> list[str]:
    """What two processes say of which those `told` get this signal, one soon after the other, once
    they have begun."""
    try:
        end = time.monotonic() + 60
        while not begun():
            assert time.monotonic() < end and all(process.poll() is None for process in started)
            time.sleep(0.05)
        for index in told:
            started[index].send_signal(number)
            time.sleep(0.1)
        said = [process.communicate(timeout=30) for process in started]
    finally:
        for process in started:
            process.kill()
    assert [process.returncode for process in started] == [130, 130], said
    return [error for _, error in said]


@pytest.mark.parametrize(
    ("number", "told"),
    [
        (signal.SIGINT, (1, 0)),
        (signal.SIGTERM, (1,)),
        pytest.param(signal.SIGTERM, (0,), marks=pytest.mark.release),
    ],
)
def test_a_stop_while_all_train_saves(tmp_path, number, told):
    path = tmp_path / "stardiff/metrics.jsonl"
    started = start_two("trains", str(tmp_path))
    said = stop_two(started, lambda: path.exists() and path.read_text() != "", number, told)
    assert all("same command resumes from it" in error for error in said)
    assert len(checkpoint.steps(tmp_path / "stardiff/checkpoints")) == 1


def test_sigterm_ends_several_processes_that_do_not_train(tmp_path):
    started = start_two("waits", str(tmp_path))
    stop_two(started, lambda: len(list(tmp_path.iterdir())) == 2, signal.SIGTERM)


def test_a_batch_that_the_devices_cannot_share_is_a_mistake_at_once(tmp_path, monkeypatch):
    here = jax.devices() * 2
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    monkeypatch.setattr(jax, "devices", lambda *_: here)
    train_config = config.TrainConfig(batch_size=33)
    settings = config.RunConfig(out=str(tmp_path / "run"), train=train_config)
    with mistakes.of("train.batch_size", 33):
        pipeline.run(settings, ["collect", "train"], "")
    assert not (tmp_path / "run").exists()


def test_half_of_the_variables_is_a_mistake(monkeypatch):
    monkeypatch.setenv("JAX_COORDINATOR_ADDRESS", "localhost:1")
    monkeypatch.setenv("JAX_NUM_PROCESSES", "2")
    monkeypatch.delenv("JAX_PROCESS_ID", raising=False)
    with mistakes.of(", ".join(processes._VARIABLES), "localhost:1"):
        processes.join()


@pytest.mark.parametrize(
    ("address", "count", "index", "argument"),
    [
        ("", "2", "", ", ".join(processes._VARIABLES)),
        ("", "", "1", ", ".join(processes._VARIABLES)),
        ("localhost:1", "2", "2", "JAX_PROCESS_ID"),
    ],
)
def test_variables_that_cannot_be_are_a_mistake(monkeypatch, address, count, index, argument):
    for name, value in zip(processes._VARIABLES, (address, count, index), strict=True):
        monkeypatch.setenv(name, value)
    with mistakes.of(argument):
        processes.join()


@pytest.mark.parametrize(
    ("tasks", "apart", "joins"),
    [("2", "", [2]), ("2(x2)", "", [4]), ("2(x3),1", "", [7]), ("1", "", []), ("2", "1", [])],
)
def test_the_tasks_of_a_step_of_srun_are_one_run_unless_kept_apart(
    monkeypatch, tasks, apart, joins
):
    counts = []
    monkeypatch.setattr(processes, "_initialize", lambda name, count, hint: counts.append(count))
    for name in processes._VARIABLES:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("SLURM_STEP_NUM_TASKS", tasks)
    if apart:
        monkeypatch.setenv("JAX_NUM_PROCESSES", apart)
    processes.join()
    assert counts == joins


def test_a_number_of_tasks_of_another_form_is_a_mistake(monkeypatch):
    monkeypatch.setenv("SLURM_STEP_NUM_TASKS", "two")
    with mistakes.of("SLURM_STEP_NUM_TASKS", "'two'"):
        processes.join()


LONE = """
from starjax import cli
from starjax.runtime import processes
processes._LATEST_S = {latest}
cli.run(lambda argv: processes.join() or 0)
"""


def start_lone(latest: int) -> subprocess.Popen:
    """The first process of a run whose second one never comes."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        address = f"localhost:{free.getsockname()[1]}"
    values = dict(zip(processes._VARIABLES, (address, "2", "0"), strict=True))
    return subprocess.Popen(
        [sys.executable, "-c", LONE.format(latest=latest)],
        env={**os.environ, **values},
        stderr=subprocess.PIPE,
        text=True,
    )


def test_a_process_that_waits_for_others_is_ended_by_a_signal():
    with start_lone(latest=60) as lone:
        assert lone.stderr
        line = lone.stderr.readline()
        lone.send_signal(signal.SIGTERM)
        assert "waits for 2 processes" in line and lone.wait(30) == 130


def test_a_process_whose_others_do_not_come_ends_in_a_line():
    with start_lone(latest=1) as lone:
        said = lone.communicate(timeout=60)[1].splitlines()
    assert lone.returncode == 2 and len(said) == 2
    assert said[1].startswith("starjax: JAX_NUM_PROCESSES: expected 2 processes")


DIFFERENT = """
import os, pathlib, sys
from starjax import cli
from starjax.cli import session
index = os.environ["JAX_PROCESS_ID"]

def command(argv):
    session.start_jax()
    folder = pathlib.Path(sys.argv[1].replace("INDEX", index))
    settings = {"seed": sys.argv[2].replace("INDEX", index)}
    with session.Session("starjax run", folder).shared(settings) as share:
        share.first("begun", lambda: True)
    return 0

cli.run(command)
"""


@pytest.mark.parametrize(
    ("folder", "seed", "code"), [("run", "0", 0), ("runINDEX", "0", 2), ("run", "INDEX", 2)]
)
def test_processes_of_other_settings_or_folders_end_in_a_line(tmp_path, folder, seed, code):
    script = tmp_path / "different.py"
    script.write_text(DIFFERENT)
    started = several.start(script, str(tmp_path / folder), seed)
    said = several.finish(started, timeout_s=90)
    assert [process.returncode for process in started] == [code, code], said
    for _, error in said:
        assert ("command, settings and folder: expected the same" in error) == bool(code)


def test_one_process_agrees_with_itself():
    assert processes.agree(False, 7) == (False, 7)
    assert processes.is_first() and processes.is_alone()
