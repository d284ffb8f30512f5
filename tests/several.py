"""Starts the processes of one run, for tests of their common work."""

import os
import socket
import subprocess
import sys
from pathlib import Path


def start(script: str | Path, *words: str, count: int = 2) -> list[subprocess.Popen]:
    """`count` processes of one run, each of which runs the script with these words."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    started = []
    for index in range(count):
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
            "JAX_COORDINATOR_ADDRESS": f"localhost:{port}",
            "JAX_NUM_PROCESSES": str(count),
            "JAX_PROCESS_ID": str(index),
        }
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        command = [sys.executable, str(script), *words]
        started.append(subprocess.Popen(command, env=environment, **pipes))
    return started


def finish(started: list[subprocess.Popen], timeout_s: float = 300.0) -> list[tuple[str, str]]:
    """What they print to both streams, once all have ended; none is left behind."""
    try:
        return [process.communicate(timeout=timeout_s) for process in started]
    finally:
        for process in started:
            process.kill()
