"""Says in one line that another process of the run was lost.

jax ends the processes that are left from native code, which writes some twenty lines with a stack
trace and aborts. What native code writes to the standard error stream therefore goes through a
small process of its own, this file, which replaces those lines and passes on all others.
"""

import os
import select
import subprocess
import sys

LINE = "another process of this run was lost; the same command goes on from what is done"
_FATAL = b"JAX distributed service detected fatal errors"
# Lines before that one.
_SIGNS = (b"coordination_service", b"preemption_sync_manager")
_HELD_S = 2.0  # how long lines may be held that begin with such a sign


def watch() -> None:
    """Puts the process between native code and the standard error stream."""
    read, write = os.pipe()
    command = [sys.executable, "-I", "-S", __file__]
    subprocess.Popen(command, stdin=read, stdout=subprocess.DEVNULL, start_new_session=True)
    os.close(read)
    sys.stderr.flush()
    own = os.fdopen(os.dup(2), "w", buffering=1, encoding=sys.stderr.encoding, errors="replace")
    os.dup2(write, 2)
    os.close(write)
    sys.stderr = own


def main() -> None:
    """Passes lines on until the stream ends."""
    held: list[bytes] = []
    is_lost = False
    rest = b""
    while True:
        ready, _, _ = select.select([0], [], [], _HELD_S if held else None)
        if not ready:
            held = _passed(held)
            continue
        found = os.read(0, 1 << 16)
        *lines, rest = (rest + found).split(b"\n")
        for line in [*lines, *([rest] if not found and rest else [])]:
            if _FATAL in line:
                held, is_lost = [], _told(is_lost)
            elif held or any(sign in line for sign in _SIGNS):
                held.append(line)
            elif not is_lost:
                _passed([line])
        if not found:
            _passed([] if is_lost else held)
            return


def _passed(lines: list[bytes]) -> list[bytes]:
    os.write(2, b"".join(line + b"\n" for line in lines))
    return []


def _told(before: bool) -> bool:
    if not before:
        _passed([LINE.encode()])
    return True


if __name__ == "__main__":
    main()
