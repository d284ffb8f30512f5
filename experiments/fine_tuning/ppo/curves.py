"""How fast examples/11_ppo.py learns reach, from several seeds.

python experiments/fine_tuning/ppo/curves.py [--seeds 3] [the example's own flags]
"""

import argparse
import json
import pathlib
import subprocess
import sys
from pathlib import Path
from typing import Any

sys.path.append(str(pathlib.Path(__file__).parents[3] / "benchmarks"))
import _timing

EXAMPLE = Path(__file__).parents[3] / "examples" / "11_ppo.py"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=3)
    arguments, flags = parser.parse_known_args()
    curves = {str(seed): learn(seed, flags) for seed in range(arguments.seeds)}
    found = {"flags": flags, "curves": curves}
    found["mean"] = mean(list(curves.values()))
    print("written to", _timing.write("ppo", {"results": found}))


def learn(seed: int, flags: list[str]) -> list[dict[str, float]]:
    """The example's curve: a process of its own, which compiles as a user's does."""
    command = [sys.executable, str(EXAMPLE), "--seed", str(seed), *flags]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout
        curve = []
        for line in process.stdout:
            print(seed, line, end="", flush=True)
            curve.append(json.loads(line))
    if process.returncode:
        sys.exit(process.returncode)
    return curve


def mean(curves: list[list[dict[str, float]]]) -> dict[str, Any]:
    """Point of the curve, from 1 -> mean over the seeds, and the least success."""
    points = {}
    for i, at in enumerate(zip(*curves, strict=True), 1):
        point = {name: sum(x[name] for x in at) / len(at) for name in at[0]}
        points[str(i)] = point | {"least": min(x["success"] for x in at)}
    return points


if __name__ == "__main__":
    main()
