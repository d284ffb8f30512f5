"""Parts made wrong on purpose: each is found by its check, with the measured value; none raises."""

import dataclasses
import types

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax import rcm, testing
from starjax.cli.presets import PRESETS
from starjax.core.learners import Learner
from starjax.core.methods import Method
from starjax.evaluation.disturbances import DISTURBANCES
from starjax.evaluation.expert import ExpertEpisodes
from starjax.policies.external import ExternalPolicy
from starjax.policies.models.encoders import Trunk
from starjax.policies.sequences import SequenceModel, observation_vector
from starjax.sim import env as envs
from starjax.sim import registries
from starjax.sim.task import Field
from starjax.testing import disturbances as disturbance_checks
from starjax.testing import kinds, task_starts
from starjax.testing import tasks as task_checks
from starjax.testing.base import FAILED


def faults(checks):
    return {check.subject: check.text for check in checks if check.status == FAILED}


def found(kind, part):
    """Returns the faults of a part, by the check that found them."""
    with testing._registered(kind, part) as name:
        return faults(kinds.run(kind, name, 1))


# Tasks: functions of `reach` in place of its own, judged at the same resets.


@pytest.fixture(scope="module")
def reach():
    env = envs.make("reach", observation="state")
    return env, task_starts.resets(env)


def status_of(**changed):
    real = registries.tasks.get("reach").status
    return lambda *of: real(*of)._replace(**{n: jnp.asarray(x) for n, x in changed.items()})


def state_of(change):
    return lambda bound, layout, measurements: change(layout.p)


STARTS = {
    "succeeds at once": ({"status": status_of(success_now=True)}, "start", "16 of 16"),
    "lost at once": ({"status": status_of(lost=True)}, "start", "lost"),
    "stage beyond its names": ({"status": status_of(stage=jnp.int32(9))}, "start", "stage 9"),
    "reward above 1": ({"status": status_of(reward=40.0)}, "start", "40"),
    "reward of NaN": ({"status": status_of(reward=np.nan)}, "start", "nan"),
    "state in mm": ({"state": state_of(lambda p: 1e3 * p)}, "state", "mm"),
    "state of NaN": ({"state": state_of(lambda p: p * jnp.nan)}, "state", "finite"),
    "far point": ({"state": state_of(lambda p: p + 2.0)}, "state", "m from the tips"),
    "rotation above 1": (
        {"state": state_of(lambda p: 30 + p), "fields": (Field("R", 3, "unit"),)},
        "state",
        "within [-1, 1]",
    ),
}


@pytest.mark.parametrize("name", STARTS)
def test_tasks_at_reset(reach, name):
    changes, subject, words = STARTS[name]
    env, states = reach
    wrong = faults(task_starts.judged(env._replace(task=env.task._replace(**changes)), states))
    assert list(wrong) == [subject] and words in wrong[subject]


def test_a_sound_task_at_reset(reach):
    assert not faults(task_starts.judged(*reach))


@pytest.mark.parametrize("is_hidden", [False, True])
def test_a_state_without_the_goal(reach, is_hidden):
    env, states = reach
    at_goal = states.measurements.replace(tip=states.layout.p, speed=jnp.zeros(16))
    last = states.replace(measurements=at_goal, success=jnp.ones(16, bool))
    if is_hidden:
        tip = lambda bound, layout, measurements: measurements.tip  # noqa: E731
        env = env._replace(task=env.task._replace(state=tip))
    lines = list(task_starts.hidden_goals(env, last))
    assert len(lines) == is_hidden


def slot_of(task, **changed):
    return (task.slots[0]._replace(**changed),)


RECORDS = {
    "trocar in mm": lambda t: {"slots": slot_of(t, p_world_ref=(0.0, 0.0, 150.0))},
    "radius in mm": lambda t: {"trocars": t.trocars._replace(radius=1e3 * t.trocars.radius)},
    "polar in degrees": lambda t: {"trocars": t.trocars._replace(polar=57.3 * t.trocars.polar)},
    "floor of NaN": lambda t: {"floor": np.nan},
    "roll of NaN": lambda t: {"slots": slot_of(t, roll_zero=np.nan)},
    "rot6d of 4": lambda t: {"fields": (Field("R", 4, "rot6d"),)},
}


@pytest.mark.parametrize("name", RECORDS)
def test_records_of_tasks(name):
    task = registries.tasks.get("reach")
    assert len(list(task_checks.ranges(task._replace(**RECORDS[name](task))))) >= 1
    assert not list(task_checks.ranges(task))


@pytest.mark.parametrize(("error", "is_wrong"), [(0.063, True), (0.0005, False)])
def test_an_expert_that_ignores_the_trocar(reach, error, is_wrong):
    env, states = reach
    last = jax.device_get(states.replace(success=jnp.ones(16, bool), step=jnp.full(16, 60)))
    ran = ExpertEpisodes(
        last=last,
        command=None,
        at_collision=last,
        errors=np.full((16, 100), error),
        still=np.zeros((16, 100), bool),
        finite=np.ones(16, bool),
        apart=np.full(16, error),
        wall_s=1.0,
    )
    wrong = faults(task_checks._outcomes(env, "expert default", ran))
    assert ("63" in wrong.get("expert default", "")) == is_wrong
    assert ("63" in wrong.get("expert default, recorded commands", "")) == is_wrong


@pytest.mark.parametrize("is_reversed", [False, True])
def test_a_reversed_reward(reach, is_reversed):
    env, states = reach
    at_goal = states.measurements.replace(tip=states.layout.p, speed=jnp.zeros(16))
    last = states.replace(measurements=at_goal, success=jnp.ones(16, bool))
    if is_reversed:
        real = env.task.status
        worth = lambda status: status._replace(reward=1.0 - status.reward)  # noqa: E731
        env = env._replace(task=env.task._replace(status=lambda *of: worth(real(*of))))
    lines = list(task_starts.unrewarded(env, last))
    assert len(lines) == is_reversed and all("0 at success" in line for line in lines)


def test_one_layout_for_all_keys(reach):
    env, states = reach
    same = states.replace(layout=jax.tree.map(lambda x: jnp.repeat(x[:1], 16, 0), states.layout))
    assert "one layout" in faults(task_starts.judged(env, same))["start"]


# Learners: a linear model, small enough to train in a moment.


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of the linear learner."""


def linear(fault=""):
    def make(options, policy, sizes):
        shape = sizes.horizon, sizes.action

        def init(key):
            size = sizes.condition
            w = 0.01 * jax.random.normal(key, (size, sizes.horizon * sizes.action))
            return {"w": w, "b": jnp.zeros(shape)}

        def predict(params, condition):
            seen = [observation_vector(condition), condition.trocar]
            if fault == "blind to the state":
                seen[0] = seen[0].at[:, -sizes.state :].set(0.0)
            if fault == "blind to images" and sizes.vision:
                seen[0] = seen[0].at[:, : -sizes.state].set(0.0)
            if fault == "blind to the trocar":
                seen[1] = 0.0 * seen[1]
            vector = jnp.concatenate(seen, -1)
            y = (vector @ params["w"]).reshape(len(vector), *shape) + params["b"]
            return y + (jnp.nan if fault == "nan" else 0.0)

        def loss(params, condition, x0):
            error = jnp.mean((predict(params, condition) - x0) ** 2)
            if fault == "loss of one step":
                error = jnp.mean((predict(params, condition) - x0)[:, 0] ** 2)
            if fault == "no target":
                error = jnp.mean(predict(params, condition) ** 2)
            return -error if fault == "away from the target" else error, {}

        def sample(params, keys, condition, reach):
            low, high = (-1.0, 1.0) if reach is None else reach
            y = jnp.clip(predict(params, condition), low, high)
            y = 0.0 * y if fault == "samples at rest" else y
            y = y[:, ::-1] if fault == "reversed in time" else y
            y = y[..., [1, 0, *range(2, sizes.action)]] if fault == "action 1" else y
            return 1e3 * y if fault == "in mm" else y

        return SequenceModel(init, lambda key, x0: x0, loss, sample)

    return Learner(Options, lambda options, policy: None, make)


LEARNERS = {
    "": "",
    "blind to the state": "input, of images",
    "blind to images": "input, of images",
    "blind to the trocar": "input, of images",
    "nan": "loss, of images",
    "no target": "training, of images",
    "away from the target": "training, of images",
    "samples at rest": "training, of images",
    "loss of one step": "training, of images",
    "reversed in time": "training, of images",
    "action 1": "training, of images",
    "in mm": "samples, of images",
}


@pytest.mark.parametrize("fault", LEARNERS)
def test_learners(fault):
    wrong = found("learner", linear(fault))
    assert (LEARNERS[fault] in wrong) == bool(fault), wrong
    assert fault or not wrong
    if fault in ("reversed in time", "action 1"):
        assert fault in wrong["training, of images"]


# Encoders.


class Pooled(nn.Module):
    """A trunk of one convolution, blind in one way."""

    width: int
    dtype: type
    fault: str

    @nn.compact
    def __call__(self, image):
        """Returns maps `[N, h / 4, w / 4, width]`."""
        if self.fault == "all":
            image = 0.0 * image
        if self.fault == "order of colours":
            image = jnp.broadcast_to(image.mean(-1, keepdims=True), image.shape)
        if self.fault == "side to side":
            image = image + image[:, :, ::-1]
        if self.fault == "even":
            image = image / image.std((1, 2, 3), keepdims=True)
        if self.fault == "channel 2":
            image = image.at[..., 2].set(0.0)
        if self.fault == "lower right":
            half = image.shape[1] // 2
            image = image.at[:, half:, half:].set(0.0)
        return nn.Conv(self.width, (4, 4), (4, 4), dtype=self.dtype)(image.astype(self.dtype))


SEEN = ["", "all", "channel 2", "lower right", "order of colours", "side to side", "even"]


@pytest.mark.parametrize("fault", SEEN)
def test_encoders(fault):
    made = Trunk(lambda width, dtype, name=None: Pooled(width, dtype, fault, name=name), 16, 4)
    wrong = found("encoder", made)
    subject = "features" if fault == "even" else "input"
    assert (subject in wrong) == bool(fault), wrong
    assert (fault if fault != "all" else "channel 0") in wrong.get(subject, "")


# Policies.


def row_of(fault):
    def act(observation):
        row = np.array(observation["observation/state"])
        if fault == "wxyz":
            row[3:7] = row[[6, 3, 4, 5]]
        if fault == "mm":
            row[:3] *= 1e3
        if fault == "no rotation":
            row[3:7] *= 0.5
        if fault == "gripper":
            row[7] = 60.0
        if fault == "blind":
            row[:3] = (0.0, 0.0, 0.05)
        if fault == "relative":
            row[:3] *= 0.01
        if fault == "exits":
            raise SystemExit(3)
        rows = np.repeat(row[None], 2, 0)
        rows[1, 7] = 60.0 if fault == "later gripper" else row[7]
        return {"text": "go", "none": None}.get(fault, rows)

    return act


POLICIES = {
    "": "",
    "wxyz": "command",
    "mm": "plan",
    "no rotation": "command",
    "gripper": "command",
    "later gripper": "command",
    "relative": "command",
    "blind": "input",
    "exits": "checks",
    "text": "plan",
    "none": "plan",
}


@pytest.mark.parametrize("fault", POLICIES)
def test_policies(fault):
    make = lambda: types.SimpleNamespace(act=row_of(fault))  # noqa: E731
    wrong = found("policy", ExternalPolicy("holds", "reach", make, observation="state"))
    assert list(wrong) == [POLICIES[fault]] * bool(fault), wrong
    assert fault != "wxyz" or "wxyz" in wrong["command"]


# Disturbances.


def test_a_disturbance_that_makes_episodes_succeed():
    plain = ({"success": np.zeros((), bool), "loose": np.zeros((), bool)}, None)
    most = ({"success": np.ones((), bool), "loose": np.ones((), bool)}, None)
    assert len(list(disturbance_checks._easier(plain, most))) == 2
    assert not list(disturbance_checks._easier(plain, plain))


@pytest.mark.slow
@pytest.mark.release
def test_a_disturbance_that_sets_success():
    def on_step(env, disturbance, state, command):
        after = env.step(state, command)
        return after.replace(success=after.success | (disturbance.level > 0)), disturbance.memory

    kind = DISTURBANCES.get("breathing")._replace(on_step=on_step)
    assert "success" in found("disturbance", kind)


@pytest.mark.parametrize(("scale", "count"), [(1.0, 0), (255.0, 1), (np.nan, 1)])
def test_images_of_disturbances(scale, count):
    kind = DISTURBANCES.get("smoke")
    worse = lambda *of: jnp.where(of[0].level > 0, scale, 1.0) * kind.on_image(*of)  # noqa: E731
    lines = list(disturbance_checks._images(kind._replace(on_image=worse)))
    assert len(lines) == count


def test_a_disturbance_that_stops_time():
    ends = dict.fromkeys(("success", "lost", "invalid"), np.zeros((), bool))
    for step, count in ((0, 1), (disturbance_checks.STEPS + disturbance_checks.HOLD, 0)):
        state = {**ends, "step": np.int32(step)}
        assert len(list(disturbance_checks._stopped((state, None)))) == count
    state |= {"step": np.int32(9), "lost": np.ones((), bool)}
    assert not list(disturbance_checks._stopped((state, None)))


@pytest.mark.parametrize("levels", [(), (1.0, 2.0), (0.0, 2.0, 1.0), (0.0, np.nan)])
def test_levels_of_disturbances(levels):
    kind = DISTURBANCES.get("breathing")._replace(levels=levels)
    assert list(disturbance_checks._levels(kind))


# Arms and tools.
ARMS = {
    "link_radius": 50.0,
    "servo_frequency": np.nan,
    "max_speed": (0.0,) * 6,
    "watched": None,
}
TOOLS = [
    ("shaft_radius", 4.0),
    ("shaft_radius", 5e-4),
    ("shaft_reach", 100.0),
    ("pad_end", 2.5),
    ("pad_end", 0.02),
    ("closed", np.nan),
    ("shaft_end", np.nan),
    ("shaft_end", -0.05),
    ("tcp", "nowhere"),
    ("pads", ("pad_left", "pad_left")),
]


@pytest.mark.parametrize("field", ARMS)
def test_arms(field):
    arm = registries.arms.get("fr5")._replace(mounts={}, **{field: ARMS[field]})
    assert found("arm", arm)


@pytest.mark.parametrize(("field", "value"), TOOLS)
def test_tools(field, value):
    tool = registries.tools.get("grasper")._replace(**{field: value})
    assert found("tool", tool)
    with pytest.raises(AssertionError, match="grasper"):
        testing.check_tool(tool)
    assert registries.tools.get("grasper") is not tool


# Methods, action spaces, presets.
ROWS = {
    "a word for a flag": ("method", Method("rcm4", label="mine", sees_trocar="no"), "record"),
    "a number as label": ("method", Method("rcm4", label=7), "record"),
    "a label of another": ("method", Method("rcm4", label="STAR-Diff"), "record"),
    "absolute": ("action_space", rcm.ACTION_SPACES["rcm3"]._replace(is_absolute=True), "facts"),
    "free": ("action_space", rcm.ACTION_SPACES["rcm4"]._replace(is_free=True), "facts"),
    "turns": ("action_space", rcm.ACTION_SPACES["rcm4"]._replace(turns=("yaw",)), "record"),
    "method": ("preset", dataclasses.replace(PRESETS["smoke"], method="nothing"), "method"),
}


@pytest.mark.parametrize("name", ROWS)
def test_rows_that_contradict_themselves(name):
    kind, part, subject = ROWS[name]
    assert subject in found(kind, part)


def test_a_sound_part_passes_by_name_and_by_record():
    testing.check_tool("grasper")
    testing.check_tool(registries.tools.get("grasper"))
    testing.check_action_space(rcm.ACTION_SPACES["rcm4"])
    testing.check_preset("smoke")


JUNK = [None, 3, "nothing:NONE", object(), lambda *of: None]


@pytest.mark.parametrize("kind", [kind for kind in kinds.kinds() if kind != "camera"])
def test_no_part_ends_in_a_traceback(kind):
    for junk in JUNK:
        rows = kinds.kinds()[kind].registry().built_in
        rows["junk"] = junk
        try:
            assert faults(kinds.run(kind, "junk", 1)), junk
        finally:
            del rows["junk"]
