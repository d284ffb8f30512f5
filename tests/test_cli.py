"""How a process of ours ends."""

import os
import subprocess
import sys
import textwrap

import pytest

from starjax import cli
from starjax.core import errors
from starjax.runtime import files


def started(code, **environment):
    """A process that runs this, with its output in pipes."""
    return subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(code)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={**os.environ, **environment},
        text=True,
    )


def test_too_little_memory_is_one_line_that_names_what_to_lower(capsys):
    def command(argv):
        raise RuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 9 bytes.\nmore of it")

    assert cli.guard(command, []) == 71
    said = capsys.readouterr().err
    assert "9 bytes. Too much" in said and "--train.batch-size" in said and said.count("\n") == 1


@pytest.mark.parametrize(
    ("error", "code", "word"),
    [
        (errors.UsageError("seed", "0 or more", -1), 2, "--seed"),
        (KeyboardInterrupt(), 130, "same command"),
        (OSError(28, "No space left on device", "runs/x"), 74, "runs/x"),
        (OSError(28, "No space left on device", "runs/x"), 74, "cannot write:"),
        (PermissionError(13, "Permission denied", "runs/y"), 74, "cannot read or write: runs/y"),
        (OSError(36, "File name too long", "runs/y"), 74, "File name too long"),
        (MemoryError("Unable to allocate 9 GiB"), 71, "too little memory (Unable to allocate 9"),
        (files.StorageError("runs/z: the disk is full"), 74, "runs/z"),
    ],
)
def test_guard_turns_what_a_user_can_mend_into_one_line(error, code, word, capsys):
    def command(argv):
        raise error

    assert cli.guard(command, []) == code
    said = capsys.readouterr().err
    assert word in said and len(said.strip().splitlines()) == 1


def test_guard_lets_a_fault_of_the_program_through():
    def command(argv):
        raise ValueError("a bug")

    with pytest.raises(ValueError, match="a bug"):
        cli.guard(command, [])


@pytest.mark.parametrize("closed", ["stdout", "stderr"])
def test_closed_outputs_are_no_fault(closed):
    code = f"""
        import os, signal, sys
        sys.{closed} = None  # as Python has it of `>&-`
        from starjax import cli
        from starjax.runtime import progress

        def command(argv):
            with progress.track("Some", 1, unit="things") as advance:
                advance(1)
            os.kill(os.getpid(), signal.SIGTERM)

        cli.run(command)
    """
    process = started(code)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 130 and "Traceback" not in said


def test_a_process_that_is_terminated_says_so():
    code = """
        import time
        from starjax import cli

        def command(argv):
            print("begun", flush=True)
            time.sleep(60)

        cli.run(command)
    """
    process = started(code)
    assert process.stdout and process.stdout.readline()
    process.terminate()
    assert "stopped" in process.communicate(timeout=60)[1] and process.returncode == 130


@pytest.mark.parametrize(
    ("job", "said"),
    [
        # as jax's C++ does
        ("except KeyboardInterrupt: time.sleep(0.1)", ""),
        ("finally: time.sleep(2); print('saved')", "saved\n"),
    ],
    ids=["lost", "cleaning up"],
)
def test_a_stop_is_insisted_on_but_disturbs_no_cleaning_up(job, said):
    code = f"""
        import time
        from starjax import cli

        def command(argv):
            try: print("begun", flush=True); time.sleep(60)
            {job}
            time.sleep(60)

        cli.run(command)
    """
    process = started(code)
    assert process.stdout and process.stdout.readline() == "begun\n"
    process.terminate()
    rest, error = process.communicate(timeout=30)
    assert process.returncode == 130 and rest == said and error.count("\n") == 1


def test_a_second_stop_while_the_first_is_told_is_no_traceback():
    process = started("""
        import signal
        from starjax import cli

        def command(argv):
            raise KeyboardInterrupt

        def again(number, handler):
            signal.signal = set_handler
            raise KeyboardInterrupt

        def guard(*given, first=cli.guard):
            code, signal.signal = first(*given), again
            return code

        set_handler, cli.guard = signal.signal, guard
        cli.run(command)
    """)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 130 and error.count("\n") == 1


def test_ctrl_c_in_a_callback_of_the_collector_is_not_lost():
    """Python drops exceptions there, and jax has such a callback."""
    code = """
        import gc, os, signal, time
        from starjax import cli

        # a shell's background job, as tests may be, is born deaf to it
        signal.signal(signal.SIGINT, signal.default_int_handler)

        def callback(phase, info):
            gc.callbacks.clear()
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0)

        def command(argv):
            gc.callbacks.append(callback)
            gc.collect()
            for _ in range(1000):
                time.sleep(0.01)
            return 0

        cli.run(command)
    """
    command = [sys.executable, "-c", textwrap.dedent(code)]
    found = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert found.returncode == 130, found.stderr
    assert found.stderr == "starjax: stopped; rerun the same command to resume\n"


def test_a_job_whose_reader_went_away_does_not_claim_to_be_done():
    """As in `starjax run | head`."""
    code = """
        from starjax import cli

        def command(argv):
            for line in range(100000):
                print(line)
            return 0

        cli.run(command)
    """
    process = started(code)
    assert process.stdout and process.stdout.readline()
    process.stdout.close()
    assert process.stderr and process.stderr.read() == "" and process.wait(60) == 141


def test_a_warning_of_ours_is_a_line_and_of_others_says_where():
    process = started(
        """
        import warnings

        from starjax import cli

        def work(argv):
            warnings.warn_explicit("step 3 is damaged", UserWarning, cli.__file__, 7)
            warnings.warn_explicit("old", UserWarning, "elsewhere/starjax.py", 9)
            return 0

        cli.run(work)
        """
    )
    said = process.communicate(timeout=60)[1].splitlines()
    assert said == ["starjax: step 3 is damaged", "elsewhere/starjax.py:9: UserWarning: old"]


def test_a_cache_that_takes_no_program_is_one_line_and_work_goes_on():
    process = started(
        """
        from starjax import cli
        from starjax.runtime import jax_start, xla

        def work(argv):
            xla.prepare_xla()
            jax_start.require_devices()
            import jax, jax.numpy as jnp
            for i in range(3):
                print(float(jax.jit(lambda x: x + i)(jnp.ones(3 + i)).sum()))
            return 0

        cli.run(work)
        """,
        JAX_COMPILATION_CACHE_DIR="/proc/self/task",  # it exists, and replaces no file of others
    )
    said, warned = process.communicate(timeout=60)
    assert process.returncode == 0 and said.split() == ["3.0", "8.0", "15.0"]
    (warning,) = [line for line in warned.splitlines() if "/proc/self/task" in line]
    assert "doctor" in warning and len(warned.splitlines()) <= 2  # the other: jax starts
