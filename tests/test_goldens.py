"""Identities and numbers that a move of code must not change.

    python tests/test_goldens.py PART...    writes tests/golden/identity/PART.json anew

- `model` (bytes of the compiled MJCF) is separate from the digests of users' files. Versions
  and digests of code are those of core/accepted.json.
- `steps`, `losses` and `trials` hold to the last bit on the machine that wrote them (`machine`),
  and within `TOLERANCE` on others.
- A commit that changes an expert rewrites `steps` and `trials` and leaves golden/benchmark.json;
  one that changes the digests there leaves `trials`: version 1 still means the same.
"""

import ast
import dataclasses
import hashlib
import json
import math
import pathlib
import sys
import tempfile
import zipfile
import zlib
from typing import Any

import pytest

if __name__ == "__main__":
    import conftest  # noqa: F401  XLA is set up before jax is imported

import jax
import numpy as np

from starjax import cli
from starjax.cli import options, presets
from starjax.core import config_json, methods
from starjax.data import load, schema
from starjax.evaluation import protocol
from starjax.evaluation.disturbances import DISTURBANCES, base
from starjax.policies import packaged, policy_file
from starjax.runtime import xla
from starjax.sim import env, registries
from starjax.sim.rollouts import agent, engine, episodes, trocars
from starjax.training import log, loop

HERE = pathlib.Path(__file__).parent
GOLDEN = HERE / "golden" / "identity"
OLD = HERE / "golden" / "opened" / "run_4bec7307.zip"
SOURCE = HERE.parent / "src" / "starjax"
DIGITS = 12  # characters of a digest
SHORT = 60  # characters of a value that a golden file shows as it is
# Values of the machine and its packages.
VOLATILE = ("versions", "jax_settings", "platform", "lanes", "chunk", "command")
CODE = ("parts", "source")  # core/accepted.json has them
STEPS, LOSSES, TRIALS, LANES = 30, 100, 3, 8
# On another machine: m of a tip after `STEPS`, parts of a loss, trials of a task's 36, parts of
# their mean length.
TOLERANCE = {"tip_m": 1e-4, "losses": 0.05, "successes": 3, "steps": 0.03}


def datasets() -> dict[str, Any]:
    """Description of a dataset of each task and expert; long values as digests.

    For states; one more for images.
    """
    found = {"model": {}, "described": {}}
    kinds = [(name, "state") for name in registries.tasks.names()] + [("peg_transfer", "image")]
    for name, observation in kinds:
        made = env.make(name, observation=observation)
        for expert in made.task.experts:
            settings = schema.DemoSettings(per_trocar=1, seed=0, max_steps=10, expert=expert)
            described = plain(schema.describe(made, made.task.trocars, settings))
            key = f"{name}.{expert}.{observation}"
            found["model"][key] = described.pop("model")[:DIGITS]
            found["described"][key] = shortened(described)
    return found


def weights() -> dict[str, Any]:
    """Number and digest of the names of each packaged policy's arrays."""
    found = {}
    for name in packaged.names():
        trained = policy_file.load(packaged.locate(name))
        tree = {"params": trained.params, "normalizer": trained.normalizer}
        paths = [jax.tree_util.keystr(x) for x, _ in jax.tree_util.tree_leaves_with_path(tree)]
        found[name] = {"arrays": len(paths), "names": digest(paths)}
    return found


class Planned(Exception):
    """Ends an evaluation that has written its plan."""


def plans() -> dict[str, Any]:
    """plan.json of an evaluation and of a sweep, as the commands write it."""
    words = ["--policy", "compact", "--eval.trials", "2"]
    grid = ["--radii-cm", "1", "2", "--azimuths", "3"]

    def stop(*_: Any, **__: Any) -> None:
        raise Planned

    found = {"model": {}}
    for command, more in {"evaluate": [], "sweep": grid}.items():
        with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
            patch.chdir(folder)
            patch.setattr(engine, "make", stop)
            with pytest.raises(Planned):
                cli.load(command)([*words, *more])
            (path,) = pathlib.Path(folder).rglob("plan.json")
            plan = json.loads(path.read_text())
        found["model"][command] = plan.pop("model")[:DIGITS]
        found[command] = shortened(plan)
    return found


def preset_settings() -> dict[str, Any]:
    """Settings of each preset."""
    return {name: config_json.as_json(row) for name, row in presets.PRESETS.items()}


def flags() -> dict[str, list[str]]:
    """Flags of each command."""
    found = {}
    for command in cli.COMMANDS:
        with pytest.raises(options.Declared) as declared:
            cli.load(command)(options.DECLARE)
        found[command] = sorted(options.flags(declared.value.settings))
    return found


def groups() -> list[str]:
    """Groups of entry points, as the registries in the source name them."""
    found = set()
    for path in SOURCE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_bytes())):
            match node:
                case ast.Call(func=ast.Name(id="Registry"), args=[ast.Constant(value=kind), *_]):
                    found.add(f"starjax.{kind[:-1]}ies" if kind[-1] == "y" else f"starjax.{kind}s")
                case ast.Call(
                    func=ast.Name(id="entries") | ast.Attribute(attr="entries"),
                    args=[ast.Constant(value=group)],
                ):
                    found.add(group)
    return sorted(found)


def streams() -> dict[str, int]:
    """Number that each disturbance folds into its key."""
    return {name: zlib.crc32(base.stream(name).encode()) for name in DISTURBANCES.names()}


def steps() -> dict[str, Any]:
    """First `STEPS` control steps of each expert, at a seen and an unseen configuration."""
    found = {}
    for name in registries.tasks.names():
        made = env.make(name, observation="state")
        unseen = int(np.argmin(made.task.is_seen)) if not made.task.is_seen.all() else 1
        for expert in made.task.experts:
            ended = simulate(made, expert, [(0, 0), (unseen, 0)], STEPS, 2)
            tips = [episode.joined("p")[-1].ravel().tolist() for episode in ended]
            found[f"{name}.{expert}"] = {"bits": list(map(bits, ended)), "tip_m": tips}
    return found


def losses() -> dict[str, Any]:
    """Losses of the first `LOSSES` steps of preset `smoke`, trained on a committed dataset."""
    preset = presets.PRESETS["smoke"]
    train = dataclasses.replace(
        preset.train, steps=LOSSES, log_every=1, checkpoint_every=LOSSES, steps_per_call=1
    )
    with tempfile.TemporaryDirectory() as folder:
        zipfile.ZipFile(OLD).extractall(folder)
        (root,) = pathlib.Path(folder).glob("*/demos-*")
        dataset = load.load(root, report=lambda line: None).dataset
        task = registries.tasks.get("reach")
        method = methods.METHODS[preset.method]
        loop.run(method, preset.policy, train, dataset, task, f"{folder}/train", preset.seed)
        lines = log.read(pathlib.Path(folder) / "train" / "metrics.jsonl")
    values = [line["loss"] for line in lines if line["kind"] == "train"]
    return {"losses": values}


def trials() -> dict[str, Any]:
    """Whole trials of the first expert of each task of the benchmark, `TRIALS` a configuration."""
    found = {}
    for name, limit_s in protocol.TIME_LIMIT_S.items():
        made = env.make(name, observation="state")
        group = [(i, trial) for i in range(protocol.TROCARS) for trial in range(TRIALS)]
        ended = []
        for first in range(0, len(group), LANES):
            part = group[first : first + LANES]
            ended += simulate(made, "", part, math.ceil(limit_s * made.control_hz), LANES)
        found[name] = {
            "bits": [
                digest([bits(one) for one in ended[first : first + TRIALS]])
                for first in range(0, len(ended), TRIALS)
            ],
            "successes": sum(one.outcome["success"] for one in ended),
            "steps": sum(one.outcome["length"] for one in ended),
        }
    return found


def simulate(
    made: Any, expert: str, group: list[episodes.Trial], max_steps: int, lanes: int
) -> list[episodes.Episode]:
    """Returns the episodes of an expert's trials, in their order."""
    rules = engine.RolloutSettings(protocol.SEED, None, max_steps, lanes)
    listed = trocars.listed(made.task.trocars, len(made.p_world_ref))
    acting = agent.from_single(made.task.expert(expert))
    run = engine.make(made, acting, listed, rules, episodes.DEMONSTRATION)
    ended = [episode for segment in run(None, group) for episode in segment.ended]
    return sorted(ended, key=lambda episode: episode.trial)


def bits(episode: episodes.Episode) -> str:
    """Returns the digest of an episode's outcome and of all its arrays."""
    total = hashlib.sha256(json.dumps(episode.outcome, sort_keys=True).encode())
    for name in sorted(episode.arrays):
        total.update(name.encode() + np.ascontiguousarray(episode.joined(name)).tobytes())
    return total.hexdigest()[:DIGITS]


def machine() -> dict[str, Any]:
    """Returns the parts of this machine that decide last bits."""
    versions = xla.versions()
    names = ("jaxlib", "mujoco", "mujoco-mjx")
    return {"cpu": xla.hardware()["cpu"], "cores": xla.cores(), **{n: versions[n] for n in names}}


def shortened(values: dict[str, Any]) -> dict[str, Any]:
    """Returns JSON values without those of the machine, digests in place of long ones."""
    kept = {name: value for name, value in values.items() if name not in VOLATILE + CODE}
    return {n: v if len(json.dumps(v)) <= SHORT else digest(v) for n, v in kept.items()}


def digest(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:DIGITS]


def plain(value: Any) -> Any:
    return json.loads(json.dumps(value, default=str))


FACTS = {
    "datasets": datasets,
    "weights": weights,
    "plans": plans,
    "presets": preset_settings,
    "flags": flags,
    "groups": groups,
    "streams": streams,
}
NUMBERS = {"losses": losses, "steps": steps}  # trials follow


def golden(part: str) -> Any:
    return json.loads((GOLDEN / f"{part}.json").read_text())


@pytest.mark.parametrize("part", FACTS)
def test_names_and_identities_are_what_they_were(part):
    frozen, now = golden(part), plain(FACTS[part]())
    mujoco = frozen.pop("mujoco", None) if isinstance(frozen, dict) else None
    if mujoco not in (None, xla.versions()["mujoco"]):  # another version compiles other bytes
        frozen.pop("model"), now.pop("model")
    assert now == frozen


@pytest.mark.parametrize(
    "part",
    [pytest.param(part, marks=pytest.mark.release) for part in ("losses", "steps")],
)
def test_numbers_are_what_they_were(part, monkeypatch):
    frozen = golden(part)
    optimized = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", False)
    try:
        now = plain(NUMBERS[part]())
    finally:
        jax.config.update("jax_disable_most_optimizations", optimized)
    if frozen.pop("machine") == machine():
        assert now == frozen
        return
    assert now.keys() == frozen.keys()
    if part == "losses":
        np.testing.assert_allclose(now[part], frozen[part], rtol=TOLERANCE[part])
        return
    for name, row in now.items():
        if part == "steps":
            np.testing.assert_allclose(
                row["tip_m"], frozen[name]["tip_m"], atol=TOLERANCE["tip_m"], err_msg=name
            )
            continue
        assert abs(row["successes"] - frozen[name]["successes"]) <= TOLERANCE["successes"], name
        assert row["steps"] == pytest.approx(frozen[name]["steps"], rel=TOLERANCE["steps"]), name


def write(part: str) -> None:
    """Writes a golden file, one line per value of its first two levels."""
    value = plain({**FACTS, **NUMBERS}[part]())
    if part in NUMBERS:
        value = {"machine": machine(), **value}
    elif isinstance(value, dict) and "model" in value:
        value = {"mujoco": xla.versions()["mujoco"], **value}

    def lines(item: Any, depth: int) -> str:
        if depth == 0 or not isinstance(item, dict):
            return json.dumps(item)
        rows = [
            f"{' ' * (3 - depth)}{json.dumps(k)}: {lines(v, depth - 1)}" for k, v in item.items()
        ]
        return "{\n" + ",\n".join(rows) + "\n" + " " * (2 - depth) + "}"

    GOLDEN.mkdir(exist_ok=True)
    (GOLDEN / f"{part}.json").write_text(lines(value, 2) + "\n")


if __name__ == "__main__":
    for chosen in sys.argv[1:]:
        write(chosen)
