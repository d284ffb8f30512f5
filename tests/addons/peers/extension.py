"""Installs a package with a part of each kind and runs them end to end, minutes on two cores.

    python tests/addons/peers/extension.py [FOLDER]

The package is `tests/peers/lab`: a task with a hinge, a learner with a scalar parameter, a format,
a disturbance, a method, a preset, and a policy that is a program. The arm is the one with slides of
docs/extend/add-arm.md.
"""

import json
import os
import pathlib
import subprocess
import sys
import tempfile
import time

HERE = pathlib.Path(__file__).parent
sys.path.insert(0, str(HERE.parent))
import gantry  # noqa: E402

TRIALS = ["--eval.trials", "1"]
FEW = [*TRIALS, "--eval.video-trials", "0", "--no-video"]
TRAIN = ["train", "--task", "lid", "--preset", "brief", "--method", "blind", "--out", "run"]
TREMOR = ["--disturbance", "tremor", "--levels", "0", "0.5"]
COMMANDS = {
    "train": [*TRAIN, "--policy.learner", "scaled"],
    "train again": [*TRAIN, "--policy.learner", "scaled"],
    "policy": ["evaluate", "--policy", "opener", "--out", "opener", *FEW],
    "stress": ["stress", "run/blind", *TREMOR, *TRIALS],
    "other arm": ["evaluate", "run/blind", "--arm", "gantry", *FEW],
    "list": ["list"],
    "check task": ["check", "lid", "--n", "8"],
    "check arm": ["check", "gantry"],
    "check learner": ["check", "scaled"],
    "check format": ["check", "arrays"],
    "check disturbance": ["check", "tremor"],
    "check method": ["check", "blind"],
    "check preset": ["check", "brief"],
    "check policy": ["check", "opener"],
}


def main(folder: pathlib.Path) -> int:
    """Runs every command; returns 1 if one failed."""
    begun = time.monotonic()
    site = folder / "site"
    site.mkdir(parents=True)
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps"]
    subprocess.run([*pip, "--target", str(site), str(HERE / "lab")], check=True)
    gantry.install(site)
    paths = [str(site), os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))}
    failed = []

    def call(name: str, words: list[str]) -> None:
        start = time.monotonic()
        done = subprocess.run(
            [sys.executable, "-m", "starjax", *words],
            cwd=folder, env=environment, capture_output=True, text=True, check=False,
        )  # fmt: skip
        lines = [*done.stdout.splitlines(), *done.stderr.splitlines()]
        print(f"{name}: code {done.returncode}, {time.monotonic() - start:.0f} s", flush=True)
        print("\n".join(f"    {line}" for line in lines if line.strip()), flush=True)
        failed.extend([name] * (done.returncode != 0))

    for name, words in COMMANDS.items():
        call(name, words)
    for dataset in (folder / "run").glob("demos-*"):
        call("export", ["export", str(dataset), "tables", "--format", "arrays"])
        call("import", ["import", "tables", "back"])
    # An edit of the package makes other demonstrations, which name its version.
    task = site / "lab" / "lid.py"
    task.write_text(task.read_text().replace("OPEN = 1.0", "OPEN = 0.9"))
    call("collect edited", ["collect", *TRAIN[1:5], "--out", "run"])
    datasets = [json.loads(file.read_text()) for file in folder.glob("run/demos-*/dataset.json")]
    failed += ["other demonstrations"] * (len(datasets) != 2)
    failed += ["version"] * any(about["versions"].get("lab") != "0.1" for about in datasets)
    verdict = f"failed: {', '.join(failed)}" if failed else "all passed"
    print(f"{verdict}, {time.monotonic() - begun:.0f} s")
    return int(bool(failed))


if __name__ == "__main__":
    if len(sys.argv) > 1:
        sys.exit(main(pathlib.Path(sys.argv[1]).resolve()))
    with tempfile.TemporaryDirectory() as temporary:
        sys.exit(main(pathlib.Path(temporary)))
