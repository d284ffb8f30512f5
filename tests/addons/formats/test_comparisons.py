"""Facts of an import that contradict each other are noted or refused, as the page's tables say."""

import pathlib
import re

import mistakes
import numpy as np
import pytest
from msgspec import structs
from scipy.spatial import transform
from strangers import ARM, MAP, P_WORLD_REF, TROCARS, bring, source

from starjax.addons.formats import doubts
from starjax.addons.formats.mapping import ArmColumns, ShaftColumns

PAGE = pathlib.Path(__file__).parents[3] / "docs/use/other-peoples-data.md"
COMMANDS = {"command_position": "cp", "command_rotation": "R0"}


def changed_arm(**changed):
    return structs.replace(MAP, arms=(structs.replace(ARM, **changed),))


def added(**columns):
    """Returns a change that adds columns, functions of an episode's arrays."""
    return lambda arrays: arrays | {name: of(arrays) for name, of in columns.items()}


def relative(arrays):
    return np.diff(arrays["p0"], axis=0, append=arrays["p0"][-1:])


def wandering(arrays):
    """Moves the trocar by 2 cm along x over an episode."""
    away = np.linspace(0.0, 0.02, len(arrays["p0"]))
    return arrays["p0"] + away[:, None] * np.array([1.0, 0.0, 0.0])


def slow(arrays):
    """Takes the motion of a hundredth of the time."""
    few = np.linspace(0, len(arrays["p0"]) / 100, len(arrays["p0"]))
    return np.stack([np.interp(few, np.arange(len(x)), x) for x in arrays["p0"].T], -1)


UP = P_WORLD_REF + np.array([0.0, 0.0, 0.04]) - TROCARS[0]  # within the radius, not the angles
REVERSED = (0.0, 1.0, 0.0, 0.0)
LEANING = transform.Rotation.from_euler("x", 10, degrees=True).as_matrix()
# Name -> (row of the table, mapping, change of an episode, a word of the note).
SLIPS = {
    "rate": (
        "time stamps, `hz`",
        structs.replace(MAP, time="time"),
        added(time=lambda a: 2 * a["time"]),
        "15 Hz",
    ),
    "rate of the files": ("time stamps, `hz`", structs.replace(MAP, hz=20.0), None, "30 Hz"),
    "relative commands": (
        "commands, next tips", changed_arm(**COMMANDS), added(cp=relative), "relative"
    ),
    "commands in another frame": (
        "commands, trocars",
        changed_arm(**COMMANDS | {"command_rotation": "cR"}),
        added(cp=lambda a: a["p0"], cR=lambda a: a["R0"] @ LEANING),
        "miss the trocar",
    ),
    "gripper 0 to 1": (
        "gripper values, `gripper_closed` to `gripper_open`",
        MAP,
        added(jaws0=lambda a: 0.5 + 0.2 * a["jaws0"]),
        "gripper",
    ),
    "gripper in mm": (
        "gripper values, `gripper_closed` to `gripper_open`",
        MAP,
        added(jaws0=lambda a: 40 + 40 * a["jaws0"]),
        "gripper",
    ),
    "commanded gripper": (
        "gripper values, `gripper_closed` to `gripper_open`",
        changed_arm(command_gripper="cg"),
        added(cg=lambda a: 40 + 40 * a["jaws0"]),
        "gripper",
    ),
    "distance as success": (
        "`success`, 0 to 1",
        structs.replace(MAP, success="goal"),
        added(goal=lambda a: np.linspace(60.0, 2.0, len(a["time"]))),
        "goal ends",
    ),
    "shaft reversed": ("shafts, trocars", changed_arm(tip_turn=REVERSED), None, "before the"),
    "shaft next to": (
        "shafts, trocars",
        changed_arm(trocar="at"),
        added(at=lambda a: np.tile(TROCARS[0] + [0.01, 0.0, 0.0], (len(a["p0"]), 1))),
        "passes its trocar",
    ),
    "wandering trocar": ("trocars of an episode's halves", MAP, added(p0=wandering), "halves"),
    "frame of each episode": (
        "trocars, those of other episodes",
        MAP,
        added(p0=lambda a: a["p0"] + 0.7 * a["p0"][:1]),
        "elsewhere",
    ),
    "origin off": (
        "trocars, the task's region", structs.replace(MAP, origin=(0.0, 0.0, 0.5)), None, "region"
    ),
    "trocar above": ("trocars, the task's region", MAP, added(p0=lambda a: a["p0"] + UP), "region"),
    "little motion": ("motion", MAP, added(p0=slow), "units"),
    "state of 8": (
        "`state`, the task's state", MAP, added(state=lambda a: a["state"][:, :8]), "state"
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", SLIPS)
def test_slips_are_noted(tmp_path, name):
    _, made, change, word = SLIPS[name]
    found = bring(tmp_path, source(change=change), made)
    assert any(word in line for line in found.notes), found.notes


def test_absolute_commands_are_not(tmp_path):
    given = source(change=added(cp=lambda a: np.concatenate([a["p0"][1:], a["p0"][-1:]])))
    assert not bring(tmp_path, given, changed_arm(**COMMANDS)).notes


def skewed(arrays):
    """Turns every pose about its tip at random: no two axes meet."""
    turns = transform.Rotation.random(len(arrays["R0"]), rng=np.random.default_rng(0))
    return turns.as_matrix()


# Name -> (row of the table, mapping, change of an episode, argument of the mistake, a word of it).
REFUSED = {
    "length": (
        "quaternions, length 1",
        changed_arm(rotation_as="quat_xyzw"),
        added(R0=lambda a: 0.5 * transform.Rotation.from_matrix(a["R0"]).as_quat()),
        "rotation",
        "0.5",
    ),
    "mirrored": (
        "rotation matrices, orthonormal columns",
        MAP,
        added(R0=lambda a: a["R0"] * [1.0, 1.0, -1.0]),
        "rotation",
        "mirrored",
    ),
    "degrees of a rotation": (
        "angles of a rotation, two turns",
        changed_arm(rotation_as="euler_xyz"),
        added(R0=lambda a: transform.Rotation.from_matrix(a["R0"]).as_euler("xyz", True)),
        "rotation",
        "degrees",
    ),
    "mm": ("positions, the origin", MAP, added(p0=lambda a: 1e3 * a["p0"]), "position", "30"),
    "times": (
        "time stamps, steps",
        structs.replace(MAP, time="time"),
        added(time=lambda a: np.minimum(a["time"], 2.0)),
        "time",
        "at step",
    ),
    "degrees": (
        "angles of a wrist, half a turn",
        changed_arm(shaft=ShaftColumns(angles="wrist", instrument="prograsp")),
        added(wrist=lambda a: np.full((len(a["p0"]), 2), 30.0)),
        "angles",
        "30",
    ),
    "axes": ("axes of all poses, one point", MAP, added(R0=skewed), "PATH", "miss any one point"),
}


def test_a_joint_that_moves_the_tip_without_a_column_is_noted(tmp_path):
    """As of a URDF that says `mimic`, whose joint would stand still."""
    body = '<body name="{0}" pos="0 0 .1"><joint name="j{0}"/><geom size=".01"/>{1}</body>'
    chain = body.format("a", body.format("b", body.format("c", "")) + body.format("side", ""))
    (tmp_path / "r.xml").write_text(f"<mujoco><worldbody>{chain}</worldbody></mujoco>")
    arm = ArmColumns(joints="q", model="r.xml", joint_names=("ja", "jc"), body="c")
    made = structs.replace(MAP, arms=(arm,))
    (note,) = doubts.of_models({"q": np.zeros((3, 2))}, made, tmp_path)
    assert "joints jb of r.xml" in note
    whole = structs.replace(arm, joint_names=("ja", "jb", "jc"))
    made = structs.replace(MAP, arms=(whole,))
    assert not list(doubts.of_models({"q": np.zeros((3, 3))}, made, tmp_path))


@pytest.mark.parametrize("name", REFUSED)
def test_values_that_nothing_can_be_made_of_are_refused(tmp_path, name):
    _, made, change, argument, got = REFUSED[name]
    with mistakes.of(argument, got):
        bring(tmp_path, source(change=change), made)
    assert not (tmp_path / "d").exists()


@pytest.mark.parametrize(("header", "cases"), [("Noted", SLIPS), ("Refused", REFUSED)])
def test_the_pages_tables_have_a_row_for_each(header, cases):
    table = PAGE.read_text().partition(f"| Compared | {header} |\n")[2].partition("\n\n")[0]
    rows = set(re.findall(r"^\| (.+?) \| ", table, re.MULTILINE)) - {"|---|---|"}
    # For files, see test_bad_files.py, and of models, see above.
    others = {"sizes in headers, memory", "joints of a model, columns"}
    assert rows - others == {case[0] for case in cases.values()}
