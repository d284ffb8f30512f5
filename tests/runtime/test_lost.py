"""Of jax's last words one line is left, of others' all."""

import subprocess
import sys

import pytest

from starjax.runtime import lost

WORDS = """E1125 19:43:30 coordination_service.cc:1549] Use error polling: UNAVAILABLE: unhealthy
1
The tasks have crashed. Check the task logs for an earlier error.
F1125 19:43:30 client.h:80] Terminating: the JAX distributed service detected fatal errors.
*** Check failure stack trace: ***
    @     0x7f5b78840634  absl::SendToLog()
"""
HARMLESS = "W1125 19:47:19 preemption_sync_manager.cc:147] Failed to retrieve a notice\n"


def written(words, then=""):
    """What comes out of a process in which native code writes these words."""
    program = (
        "import os, sys, time\n"
        "from starjax.runtime import lost\n"
        "lost.watch()\n"
        "print('ours', file=sys.stderr)\n"
        f"os.write(2, {words.encode()!r})\n"
        f"{then}\n"
    )
    done = subprocess.run([sys.executable, "-c", program], stderr=subprocess.PIPE, text=True)
    return done.stderr.splitlines()


def test_last_words_are_one_line():
    found = written(f"before\n{WORDS}", "os.abort()")
    assert found == ["ours", "before", lost.LINE]


@pytest.mark.parametrize("then", ["", "time.sleep(2 * lost._HELD_S); os.write(2, b'later\\n')"])
def test_other_words_are_passed_on(then):
    found = written(HARMLESS + "compiling\nwithout an end", then)
    expected = ["ours", HARMLESS.rstrip(), "compiling", "without an end"]
    assert found[:3] == expected[:3] and "".join(found).startswith("".join(expected))
    assert not then or found[-1].endswith("later")
