"""The trocar benchmark is frozen: its numbers, and the code that its success rates depend on.

python tests/evaluation/test_protocol.py    writes the golden file anew
"""

import hashlib
import json
import pathlib

import pytest

from starjax.core import sources
from starjax.evaluation import protocol
from starjax.evaluation.disturbances import DISTURBANCES
from starjax.sim import registries

ROOT = pathlib.Path(__file__).parents[2]
SOURCE = ROOT / "src" / "starjax"
GOLDEN = ROOT / "tests" / "golden" / "benchmark.json"

# A change of their code may change the effect of commands.
PHYSICS = (
    *("sim/arm_motion.py", "sim/chain.py", "sim/control.py", "sim/dynamics.py", "sim/ik.py"),
    *("sim/linear.py", "sim/mjcf_parts.py", "sim/mounts.py", "sim/physics.py", "sim/robot.py"),
    *("sim/sampling.py", "sim/scene.py", "sim/solver.py", "sim/wrist_motion.py"),
    *("sim/arms/base.py", "sim/arms/fr5.py", "sim/tools/base.py", "sim/tools/grasper.py"),
    "sim/tools/endoscope.py",
    *("rcm/trocar.py", "rcm/rotations.py"),
)
# Draws, measurements and success of each task. Experts and phrases are not part of it.
JUDGES = (
    *("sim/task.py", "tasks/two_arms.py", "sim/collision.py", "evaluation/trials.py"),
    *(f"tasks/{name}/task.py" for name in protocol.TIME_LIMIT_S),
)
# Robots and tools of the benchmark's tasks; other parts may come and change.
PARTS_MJCF = ("arms/fr5", "tools/grasper", "tools/endoscope", "tools/endoscope30")
PARTS = ("version", "digests", "seed", "trials", "stress", "time_limit_s", "trocars")
# If only the digests differ, and trials of the changed code are those of the code before to the
# last bit (tests/sim/test_parity.py, a committed evaluation), the golden file is written anew.
CHANGED = (
    "the physics, a judge or the protocol of the trocar benchmark has changed: raise VERSION in "
    "starjax/evaluation/protocol.py, then run python tests/evaluation/test_protocol.py"
)


def code(*patterns: str) -> str:
    files = [file for pattern in patterns for file in sorted(SOURCE.glob(pattern))]
    assert files, patterns
    return sources.digest(files)


def mjcf() -> str:
    total = hashlib.sha256()
    for part in (*PARTS_MJCF, *(f"tasks/{name}" for name in protocol.TIME_LIMIT_S)):
        for file in sorted((ROOT / "mjcf" / part).rglob("*.xml")):
            total.update(f"{file.relative_to(ROOT)}\n".encode() + file.read_bytes())
    return total.hexdigest()[:16]


def trocars(name: str) -> dict:
    task = registries.tasks.get(name)
    fields = {field: values.tolist() for field, values in task.trocars._asdict().items()}
    return {**fields, "seen": task.is_seen.tolist()}


def described() -> dict:
    """All that version `protocol.VERSION` says."""
    return {
        "version": protocol.VERSION,
        "digests": {"mjcf": mjcf(), "physics": code(*PHYSICS), "judges": code(*JUDGES)},
        "seed": protocol.SEED,
        "trials": [protocol.TRIALS, protocol.SWEEP_TROCARS, protocol.STRESS_TRIALS],
        "stress": protocol.STRESS,
        "time_limit_s": protocol.TIME_LIMIT_S,
        "trocars": {name: trocars(name) for name in protocol.TIME_LIMIT_S},
    }


@pytest.mark.parametrize("part", PARTS)
def test_a_change_of_physics_or_judge_raises_the_version(part):
    assert described()[part] == json.loads(GOLDEN.read_text())[part], CHANGED


def test_every_task_of_the_protocol_has_its_own_trocars_and_limit():
    for name, limit_s in protocol.TIME_LIMIT_S.items():
        task = registries.tasks.get(name)
        assert task.time_limit_s == limit_s
        assert len(task.is_seen) == protocol.TROCARS
        assert task.is_seen[: protocol.SEEN].all() and not task.is_seen[protocol.SEEN :].any()


def test_the_default_levels_of_every_disturbance_have_the_protocols():
    straight = {n for n in DISTURBANCES.built_in if not DISTURBANCES.get(n).wrist_only}
    assert set(protocol.STRESS) == straight - {"look"}  # younger than the protocol's version
    for name, level in protocol.STRESS.items():
        assert DISTURBANCES.get(name).levels[-1] == level


def test_departures_from_the_protocol_are_named():
    fits = {"task": "reach", "seed": 0, "time_limit_s": 15.0, "trocars": 12, "per_trocar": 100}
    assert not list(protocol.departures("evaluate", **fits))
    for change in ({"seed": 1}, {"time_limit_s": 60.0}, {"trocars": 8}, {"per_trocar": 49}):
        assert len(list(protocol.departures("evaluate", **{**fits, **change}))) == 1
    assert list(protocol.departures("sweep", **fits)) == ["12 trocars, not 200"]
    assert len(list(protocol.departures("stress", **{**fits, "task": "other", "seed": 3}))) == 1


if __name__ == "__main__":
    lines = [f" {json.dumps(part)}: {json.dumps(value)}" for part, value in described().items()]
    GOLDEN.write_text("{\n" + ",\n".join(lines) + "\n}\n")
