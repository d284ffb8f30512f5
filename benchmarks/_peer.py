"""Peers in processes of their own: PyTorch and ours, on the same device, in turn."""

import argparse
import json
import pathlib
import subprocess
import sys
import time
from typing import Any

from starjax.runtime import gpu

SCRIPT = pathlib.Path(__file__).with_name("peer_torch.py")


def add_flag(parser: argparse.ArgumentParser) -> None:
    """`--peer [PYTHON]`."""
    parser.add_argument(
        "--peer",
        nargs="?",
        const=sys.executable,
        metavar="PYTHON",
        help="run PyTorch's side too, by this interpreter (default: this one)",
    )


def platform() -> str:
    """`gpu` or `cpu`, known without starting jax, which would take the memory a peer needs."""
    return "gpu" if gpu.is_likely() else "cpu"


def ask(python: str | None, *arguments: str | int, tiny: bool = False) -> dict[str, Any]:
    """What `peer_torch.py` prints, and `start_to_first_call_s` since the start of its process.

    {} without a requested peer and, after a line with the reason, if it cannot run.
    """
    if python is None:
        return {}
    command = [python, str(SCRIPT), *map(str, arguments)]
    command += ["--tiny", "--device", "cpu"] if tiny else []
    start = time.time()
    run = subprocess.run(command, capture_output=True, text=True)
    if run.returncode:
        said = (run.stderr.strip() or f"exit code {run.returncode}").splitlines()[-1]
        print(f"no PyTorch peer: {said}", flush=True)
        return {}
    found = json.loads(run.stdout.splitlines()[-1])
    found["start_to_first_call_s"] = found.pop("first_call_at") - start
    times = ", ".join(f"{mode} {row['ms']:.4g} ms" for mode, row in found["rows"].items())
    print(f"PyTorch {found['torch']}, {' '.join(map(str, arguments))}: {times}", flush=True)
    return found


def compared(found: dict[str, Any], ms: float) -> dict[str, Any]:
    """The entries of a result row: the peer's best, and how many times faster ours is."""
    if not found:
        return {}
    best = found["rows"][found["best"]]["ms"]
    return {"peer_ms": best, "times_peer_speed": best / ms, "peer": found}
