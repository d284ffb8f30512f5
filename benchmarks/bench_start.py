"""From the start of the process to the end of the first training step: cold, and with the cache.

    python benchmarks/bench_start.py [--crop 96] [--peer [PYTHON]] [--tiny]

Each start is a fresh process that trains as `starjax train` does (imports, a dataset from memory,
normaliser, parameters, compilation, one step) and is stopped before it would save; the cold one
begins with an empty compilation cache, the warm one with its cache. PyTorch's is its first
compiled step, also since the start of its process.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time

import _peer


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--crop", type=int, default=96, help="of the paper's model, on a GPU")
    parser.add_argument("--tiny", action="store_true", help="a test's sizes, nothing is written")
    parser.add_argument("--child", type=float, help=argparse.SUPPRESS)
    _peer.add_flag(parser)
    asked = parser.parse_args()
    if asked.child is not None:
        return child(asked)
    rows = {}
    with tempfile.TemporaryDirectory() as cache:
        for name in ("cold", "warm"):
            rows[name] = launch(cache, asked)
            said = ", ".join(f"{k.removesuffix('_s')} {v:.1f} s" for k, v in rows[name].items())
            print(f"{name}: {said}", flush=True)
        held = sum(file.stat().st_size for file in os.scandir(cache) if file.is_file())
    work = ("train", "--crop", 48, "--batch", 4) if asked.tiny else ("train", "--crop", asked.crop)
    found = _peer.ask(asked.peer, *work, tiny=asked.tiny)
    if found:
        theirs = found["start_to_first_call_s"]
        for row in rows.values():
            row["times_peer_speed"] = theirs / row["first_step_s"]
        print(f"PyTorch: {theirs:.1f} s; {rows['cold']['times_peer_speed']:.2f} times ours cold")
    # Imported only now: a device that the children need must not be taken before them.
    import _timing

    facts = {"cache_bytes": held, "peer": found}
    name = "tiny" if asked.tiny else f"{asked.crop} px" if _peer.platform() == "gpu" else "small"
    _timing.report("start", {**facts, "results": {name: rows}}, asked.tiny)


def launch(cache: str, asked: argparse.Namespace) -> dict[str, float]:
    """Runs one start; seconds since it until each mark."""
    environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": cache}
    command = [sys.executable, __file__, "--crop", str(asked.crop), "--child", str(time.time())]
    command += ["--tiny"] if asked.tiny else []
    run = subprocess.run(command, env=environment, capture_output=True, text=True)
    if run.returncode:
        sys.exit(run.stderr)
    return json.loads(run.stdout.splitlines()[-1])


class _Enough(Exception):
    """The first step is done."""


def child(asked: argparse.Namespace) -> None:
    """One start; prints its marks as JSON."""
    marks = {}

    def mark(name: str) -> None:
        marks[f"{name}_s"] = time.time() - asked.child

    from starjax.runtime import jax_start, xla

    xla.prepare_xla()
    jax_start.require_devices("_setup", "starjax.training.loop")
    import _setup
    import jax

    from starjax.training import loop

    mark("imported")
    gpu = jax.default_backend() == "gpu"
    case = _setup.paper(asked.crop) if gpu else _setup.small(64, 64)
    case = _setup.miniature() if asked.tiny else case
    dataset = jax.block_until_ready(_setup.made_up(case.policy, 512))
    mark("dataset")
    names = iter(("state", "first_step"))

    def should_stop() -> bool:
        # Asked before every call of the loop: before the first step, and after it.
        mark(next(names))
        if len(marks) == 4:
            raise _Enough
        return False

    with tempfile.TemporaryDirectory() as folder:
        try:
            loop.run(
                _setup.METHOD,
                case.policy,
                case.train,
                dataset,
                _setup.TASK,
                folder,
                seed=0,
                should_stop=should_stop,
            )
        except _Enough:
            print(json.dumps(marks))


if __name__ == "__main__":
    main()
