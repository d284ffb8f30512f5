"""Requests to stop: Ctrl-C, SIGTERM, a closed terminal (SIGHUP), a scheduler's warning.

A command answers them with KeyboardInterrupt, training with a checkpoint. What is ignored, as
Ctrl-C by a shell's background job and SIGHUP under nohup, stays so.
"""

import contextlib
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType

# Slurm and LSF warn by a signal of the user's choice, Grid Engine by SIGUSR1 and SIGUSR2. Some
# systems do not have all of them.
STOPS = tuple(
    getattr(signal, name)
    for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGUSR1", "SIGUSR2")
    if hasattr(signal, name)
)
_AGAIN_S = 0.5  # until a KeyboardInterrupt that was lost is raised again
_SILENT_S = 1.0  # maximum delay of a stop before a line confirms it
_READERS_MS = 200  # in which the readers of our output end with the terminal

_answered = False


def interrupt_on_stops() -> None:
    """Makes every later stop raise KeyboardInterrupt.

    Python drops exceptions that are raised in a callback of its collector, and jax's C++ code some
    that are raised while it calls Python, at every start for some milliseconds. It is therefore
    raised repeatedly, but not during the cleaning up after the first one.
    """
    _announce_unanswered()
    if hasattr(signal, "setitimer"):
        signal.signal(signal.SIGALRM, _interrupt_again)
    for number in _heard():
        signal.signal(number, _interrupt)


def ignore_stops() -> None:
    """Ignores stops for the rest of the process."""
    if hasattr(signal, "setitimer"):
        signal.setitimer(signal.ITIMER_REAL, 0)
    for number in STOPS:
        signal.signal(number, signal.SIG_IGN)


@contextlib.contextmanager
def stop_signals() -> Iterator[Callable[[], bool]]:
    """Yields `should_stop`: true after a stop; the second one raises KeyboardInterrupt.

    In a thread, where Python handles no signals, it stays false: they are the main thread's.
    """
    is_requested = False

    def ask(number: int, frame: FrameType | None) -> None:
        nonlocal is_requested
        _drop_dead_outputs(number)
        if is_requested:
            raise KeyboardInterrupt
        is_requested = True

    def should_stop() -> bool:
        global _answered
        _answered = _answered or is_requested
        return is_requested

    if threading.current_thread() is not threading.main_thread():
        yield should_stop
        return
    before = {number: signal.signal(number, ask) for number in _heard()}
    try:
        yield should_stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _heard() -> list[signal.Signals]:
    return [number for number in STOPS if signal.getsignal(number) != signal.SIG_IGN]


def _interrupt(number: int, frame: FrameType | None) -> None:
    global _answered
    _answered = True
    _drop_dead_outputs(number)
    if hasattr(signal, "setitimer"):
        signal.setitimer(signal.ITIMER_REAL, _AGAIN_S, _AGAIN_S)
    raise KeyboardInterrupt


def _interrupt_again(number: int, frame: FrameType | None) -> None:
    if not isinstance(sys.exc_info()[1], KeyboardInterrupt):
        raise KeyboardInterrupt


def _announce_unanswered() -> None:
    """Prints a line for a stop that the main thread does not handle at once.

    That thread does not see a signal while it compiles a program or waits for one. The system
    writes the number of each into a pipe at once, which a thread reads.
    """
    read, write = os.pipe()
    os.set_blocking(write, False)
    signal.set_wakeup_fd(write, warn_on_full_buffer=False)

    def listen() -> None:
        while number := os.read(read, 1):
            if number[0] in STOPS:
                time.sleep(_SILENT_S)
                if not _answered:
                    line = "starjax: stopping after the program that compiles or runs now"
                    print(line, file=sys.stderr, flush=True)
                    return

    threading.Thread(target=listen, name="starjax-stops", daemon=True).start()


def _drop_dead_outputs(number: int) -> None:
    """Redirects outputs without a reader to the null device, after SIGHUP.

    Writing to them would end the work before it has saved.
    """
    if number != getattr(signal, "SIGHUP", None):
        return
    for output in (1, 2):
        poller = select.poll()
        poller.register(output, 0)  # errors alone
        if poller.poll(_READERS_MS):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, output)
            os.close(nowhere)
