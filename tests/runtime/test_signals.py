"""Stops: training saves, commands end, and the reason of a wait is printed."""

import hashlib
import os
import pty
import signal
import subprocess
import sys
import textwrap
import threading
import time

import pytest

from starjax.runtime import signals


@pytest.fixture(params=signals.STOPS, ids=lambda number: number.name)
def number(request):
    """A stop that is not ignored, as Ctrl-C is where the tests were started in the background."""
    before = signal.signal(request.param, signal.default_int_handler)
    yield request.param
    signal.signal(request.param, before)


def test_the_first_stop_asks_and_the_second_ends(number):
    with signals.stop_signals() as should_stop:
        assert not should_stop()
        os.kill(os.getpid(), number)
        assert should_stop()
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), number)
    assert signal.getsignal(number) is signal.default_int_handler


def test_a_stop_that_is_ignored_asks_nothing(number):
    signal.signal(number, signal.SIG_IGN)
    with signals.stop_signals() as should_stop:
        os.kill(os.getpid(), number)
        assert not should_stop()
    assert signal.getsignal(number) == signal.SIG_IGN


def test_in_a_thread_nothing_asks():
    found = []

    def train():
        with signals.stop_signals() as should_stop:
            found.append(should_stop())

    thread = threading.Thread(target=train)
    thread.start()
    thread.join()
    assert found == [False]


def started(body: str) -> subprocess.Popen:
    """A command of ours that runs this, with its outputs in pipes."""
    code = f"""
        import hashlib, os, signal, threading, time
        from starjax import cli
        from starjax.runtime import signals

        for number in signals.STOPS:
            signal.signal(number, signal.SIG_DFL)
        signal.signal(signal.SIGINT, signal.default_int_handler)

        def command(argv):
            {body}
            return 0

        cli.run(command)
    """
    return subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(code)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def stopped(process: subprocess.Popen, number: int) -> list[str]:
    """What a process says on its way to its end, after a stop once it has begun."""
    assert process.stdout and process.stdout.readline() == "begun\n"
    process.send_signal(number)
    said = process.communicate(timeout=60)[1].splitlines()
    assert process.returncode == 130
    return said


def test_each_stop_ends_a_command_with_one_line(number):
    said = stopped(started("print('begun', flush=True); time.sleep(60)"), number)
    assert len(said) == 1 and "same command" in said[0]


def seconds_a_round():
    """Of this hash, ten times, as another program may be in the way of some."""
    for _ in range(10):
        start = time.perf_counter()
        hashlib.pbkdf2_hmac("sha512", b"", b"", 20_000)
        yield (time.perf_counter() - start) / 20_000


def test_a_stop_during_a_compilation_is_confirmed_at_once():
    """The hash stands for a compiler: a call into C that looks at no signal for some seconds."""
    body = f"""
            threading.Timer(0.5, print, ["begun"], {{"flush": True}}).start()
            hashlib.pbkdf2_hmac("sha512", b"", b"", {int(5.0 / min(seconds_a_round()))})"""
    said = stopped(started(body), signal.SIGTERM)
    assert len(said) == 2 and all(line.startswith("starjax: stop") for line in said)


def test_a_stop_that_training_looks_at_late_says_that_it_was_heard():
    body = """
            with signals.stop_signals() as should_stop:
                print("begun", flush=True)
                time.sleep(3)
                assert should_stop()
                raise KeyboardInterrupt("saved")"""
    assert stopped(started(body), signal.SIGTERM)[1:] == ["starjax: saved"]
    body = """
            with signals.stop_signals() as should_stop:
                print("begun", flush=True)
                while not should_stop(): time.sleep(0.1)
                time.sleep(2)
                raise KeyboardInterrupt("saved")"""
    assert stopped(started(body), signal.SIGTERM) == ["starjax: saved"]


def test_training_saves_after_its_terminal_was_closed(tmp_path):
    """Lines into a terminal that is gone would be errors."""
    saved = tmp_path / "saved"
    code = f"""
        import pathlib, signal, time
        from starjax import cli
        from starjax.runtime import signals

        signal.signal(signal.SIGHUP, signal.SIG_DFL)  # ignored where the tests began under nohup

        def command(argv):
            with signals.stop_signals() as should_stop:
                while not should_stop():
                    print("step", flush=True)
                    time.sleep(0.01)
            print("one more", flush=True)
            pathlib.Path({str(saved)!r}).touch()
            raise KeyboardInterrupt

        cli.run(command)
    """
    child, terminal = pty.fork()
    if child == 0:
        os.execv(sys.executable, [sys.executable, "-c", textwrap.dedent(code)])
    assert os.read(terminal, 4)
    os.close(terminal)
    _, status = os.waitpid(child, 0)
    assert os.waitstatus_to_exitcode(status) == 130 and saved.exists()


def test_training_saves_after_its_reader_went_with_the_terminal(tmp_path):
    """As with `starjax train | tee log`."""
    body = f"""
            with signals.stop_signals() as should_stop:
                print("begun", flush=True)
                while not should_stop(): time.sleep(0.01)
            print("one more", flush=True)
            open({str(tmp_path / "saved")!r}, "w").close()
            raise KeyboardInterrupt"""
    process = started(body)
    assert process.stdout and process.stdout.readline() == "begun\n"
    process.stdout.close()
    process.send_signal(signal.SIGHUP)
    assert process.wait(60) == 130 and (tmp_path / "saved").exists()
