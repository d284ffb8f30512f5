"""Kills a job with SIGKILL again and again, then lets it finish: for tests of exact resume.

What is on disk changes only where the job asks the system to change it, so a job is killed just
before or after a chosen one of these calls; no state that a kill can leave behind lies between.
Jobs that write from native code can be killed by the clock instead.

A job is a function of one folder in a Python file. One process imports that file and forks a child
for every start: imports are paid for once; jax must not run anything on import.
"""

import importlib.util
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

_CALLS = ("fsync", "rename", "replace", "unlink", "rmdir", "mkdir")


class Survived(NamedTuple):
    """`kills` that really happened; `whole` and `killed`: name -> content of every file at the end
    of an uninterrupted run and of the one that was killed."""

    kills: int
    whole: dict[str, bytes]
    killed: dict[str, bytes]


def survive(
    file: str, job: str, tmp_path: Path, kills: int = 10, seed: int = 0, by_clock: bool = False
) -> Survived:
    """Runs function `job` of `file` once in peace, and once with `kills` kills."""
    told = [sys.executable, __file__, file, job, str(tmp_path), str(kills), str(seed)]
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
        "STARJAX_CACHE": str(tmp_path / "cache"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    done = subprocess.run(
        [*told, "clock" if by_clock else "calls"], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    happened = json.loads(done.stdout.splitlines()[-1])
    return Survived(happened, tree(tmp_path / "whole"), tree(tmp_path / "killed"))


def tree(directory: Path) -> dict[str, bytes]:
    """Content of every file of a folder by relative name, lock files aside."""
    return {
        str(path.relative_to(directory)): path.read_bytes()
        for path in sorted(directory.rglob("*"))
        if path.is_file() and not path.name.startswith(".lock")
    }


def _main(file: str, job: str, tmp: Path, kills: int, seed: int, mode: str) -> None:
    from starjax import runtime

    runtime.prepare_xla()
    spec = importlib.util.spec_from_file_location("killed_job", file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    run = getattr(module, job)
    rng = random.Random(seed)
    _start(run, tmp / "warm", None)  # fills the compilation cache before the timed run
    shutil.rmtree(tmp / "warm")
    began = time.monotonic()
    calls = _start(run, tmp / "whole", None)
    seconds = time.monotonic() - began
    happened = 0
    while happened < kills:
        if mode == "clock":
            limit = rng.uniform(0.2, 1.0) * seconds
        else:
            limit = rng.randint(1, max(calls // kills, 2))
        if _start(run, tmp / "killed", (mode, limit, rng.random() < 0.5)) is not None:
            break  # it finished first
        happened += 1
    _start(run, tmp / "killed", None)
    print(json.dumps(happened))


def _start(run, directory: Path, death) -> int | None:
    """One start of the job in a child; its number of calls, or None if it was killed."""
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(read)
        count = _count_calls(death if death and death[0] == "calls" else None)
        try:
            run(directory)
        except BaseException:
            import traceback

            traceback.print_exc()
            os._exit(1)
        os.write(write, str(count[0]).encode())
        os._exit(0)
    os.close(write)
    if death and death[0] == "clock":
        time.sleep(death[1])
        os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    with os.fdopen(read) as pipe:
        said = pipe.read()
    if os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL and death:
        return None
    assert status == 0, f"the job failed: status {status}"
    return int(said)


def _count_calls(death) -> list[int]:
    """Counts the calls that change the disk, and dies at the one that `death` names."""
    count = [0]

    def counted(call):
        def wrapped(*args, **kwargs):
            count[0] += 1
            last = death is not None and count[0] >= death[1]
            if last and death[2]:
                os.kill(os.getpid(), signal.SIGKILL)
            out = call(*args, **kwargs)
            if last:
                os.kill(os.getpid(), signal.SIGKILL)
            return out

        return wrapped

    for name in _CALLS:
        setattr(os, name, counted(getattr(os, name)))
    return count


if __name__ == "__main__":
    _main(*sys.argv[1:3], Path(sys.argv[3]), int(sys.argv[4]), int(sys.argv[5]), sys.argv[6])
