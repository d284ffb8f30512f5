"""Mistakes in a task of another package: one line that names the function and its file."""

import functools
import importlib
import pathlib
import sys
import types

import jax
import jax.numpy as jnp
import pytest

from starjax import rcm
from starjax.cli import check_command
from starjax.core import errors
from starjax.core.types import Agent, Pose
from starjax.sim import contract, scene, task_draws
from starjax.sim.task import Capsules
from starjax.testing import tasks as checks

SITE = pathlib.Path(__file__).parents[1] / "extension" / "site"
A = jnp.zeros


@pytest.fixture(scope="module")
def touch():
    """The task of another package."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(SITE)
        for module in ("starjax_toy", "starjax_toy.touch"):
            patch.delitem(sys.modules, module, raising=False)
        importlib.invalidate_caches()
        yield importlib.import_module("starjax_toy.touch")


@pytest.fixture(scope="module")
def made(touch):
    return scene.load(scene.name("touch"))


def lines(made, **changed):
    """Checks of the functions of the task with some of them replaced."""
    task = contract.guarded(made.task._replace(**changed))
    return [check.text for check in checks._functions(made._replace(task=task)) if check.text]


def fails(*_):
    raise ZeroDivisionError("by zero")


STATUS = (jnp.zeros((), bool),) * 3 + (jnp.zeros((), jnp.int32), jnp.zeros(()))
HERE = pathlib.Path(__file__).name


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("sample", lambda bound, key: {"goal": "left"}),
        ("tips", lambda bound, layout, p: A(3)),
        ("place_objects", lambda bound, qpos, layout: qpos[:-1]),
        ("measure", lambda bound, layout, readings, before: A(2 if before is None else 3)),
        ("status", lambda bound, layout, tip: STATUS),
        ("status", fails),
        ("state", lambda bound, layout, tip: A(4)),
        ("relative", lambda state, tips: A((2, 3))),
        ("label", lambda layout: {}),
        ("label", lambda layout: {"goal": 0.5}),
        ("colours", lambda bound, layout, rgb: rgb[:-1]),
        ("obstacles", lambda bound, layout, tip: Capsules(A((2, 3)), A((2, 3)), A(1))),
        ("is_sound", lambda bound, qpos, qvel: 1.0),
        ("drive", lambda bound, layout, ctrl, time: A(1)),
        ("outline", lambda m: ()),
    ],
)
def test_a_wrong_result_names_the_function_and_its_file(made, name, wrong):
    text = next(iter(lines(made, **{name: wrong})))
    assert f"task touch: {name} ({HERE}:" in text
    assert (f"in {HERE}:" in text) == (wrong is fails)


def test_right_results_are_as_they_are(made):
    assert [line.split()[0] for line in lines(made)] == ["13"]


@pytest.mark.parametrize(
    ("field", "wrong"),
    [("experts", {}), ("cameras", ()), ("stages", ()), ("settle_steps", 0), ("time_limit_s", 0.0)],
)
def test_a_record_that_is_incomplete_is_refused(touch, field, wrong):
    with pytest.raises(errors.UsageError) as caught:
        contract.guarded(touch.TASK._replace(**{field: wrong}))
    assert caught.value.argument == f"task touch: {field}"


def of_two(touch, memory, state):
    return state, memory


def one_short(touch, memory, state):
    command, memory, _ = touch.act(memory, state)
    return command._replace(pose=Pose(command.pose.R, command.pose.p[0])), memory, command


def of_nothing(touch, memory, state):
    return state.nothing, memory, None


@pytest.mark.parametrize("act", [of_two, one_short, of_nothing])
def test_an_expert_that_acts_wrongly_is_refused(touch, made, act):
    agent = Agent(lambda key, state: key, functools.partial(act, touch))
    task = touch.TASK._replace(experts={"slow": lambda: agent})
    trocar = jax.tree.map(lambda x: jnp.asarray(x[0]), task.trocars)
    state = types.SimpleNamespace(
        pose=Pose(A((1, 3, 3)), A((1, 3))),
        measured_trocar=rcm.trocar_frame(trocar, made.p_world_ref, made.roll_zero),
        layout=task.sample(made.bound, jax.random.key(0)),
    )
    with pytest.raises(errors.UsageError) as caught:
        contract.expert(task, "slow").act(jax.random.key(0), state)
    assert caught.value.argument.startswith("task touch: expert slow: act")


def test_an_unknown_expert_function_is_one_line(touch):
    task = touch.TASK._replace(experts={"default": "starjax_toy.nowhere:EXPERT"})
    with pytest.raises(errors.UsageError, match="task touch: expert default"):
        contract.expert(task, "default")


def test_graspable_geoms_need_contact_bits(made):
    (mark,) = (made.mj_model.geom("mark0").id,)
    grasped = made._replace(graspable=[mark])
    assert ["mark0" in fault for fault in checks._untouchable(grasped)] == [True]
    assert not list(checks._untouchable(made))


def test_draws_that_are_not_of_the_key_or_not_finite_are_faults(made):
    count = iter(range(10))
    task = made.task._replace(tips=lambda *_: jnp.full((1, 3), float(next(count))))
    assert any(fault.startswith("tips") for fault in checks._draws(made._replace(task=task)))
    nan = made.task._replace(place_objects=lambda bound, qpos, layout: qpos * jnp.nan)
    scene = made._replace(task=nan)
    assert [f.split()[0] for f in checks._draws(scene)] == ["place_objects"]
    with pytest.raises(errors.UsageError) as caught:
        task_draws.require_finite(scene)
    assert f"task touch: place_objects ({HERE}:" in caught.value.argument
    assert not checks._draws(made)
    task_draws.require_finite(made)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["touch"], ("task", "touch")),
        (["disturbance", "camera"], ("disturbance", "camera")),
        (["camera"], None),  # parts of two kinds
        (["toch"], None),
        ([], None),
        (["arm", "touch"], None),
    ],
)
def test_a_part_is_found_by_its_name_or_its_kind_too(touch, words, expected):
    if expected:
        assert check_command.resolve(words) == expected
    else:
        with pytest.raises(errors.UsageError):
            check_command.resolve(words)
