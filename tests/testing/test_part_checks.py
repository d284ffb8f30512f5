"""Checks of methods, action spaces, presets, encoders and policies: sound parts, one fault each."""

import dataclasses

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
import pytest

from starjax import rcm
from starjax.cli import presets
from starjax.core import methods
from starjax.core.learners import ENCODERS
from starjax.policies.external import POLICIES, ExternalPolicy
from starjax.policies.models.encoders import Trunk
from starjax.rcm import actions
from starjax.sim import registries
from starjax.testing import action_spaces, base, encoders
from starjax.testing import methods as method_checks
from starjax.testing import policies as policy_checks
from starjax.testing import presets as preset_checks
from starjax.testing import tools as tool_checks


def faults(found):
    """Returns the subjects of the checks that failed."""
    return [check.subject for check in found if check.status == base.FAILED]


ROW = methods.METHODS["dp_rcm4"]


@pytest.mark.parametrize(
    ("row", "expected"),
    [
        (ROW._replace(weights_of="mine"), []),
        (ROW, []),  # label of the method itself
        (ROW._replace(action_space="rcm5"), ["action space"]),
        (ROW._replace(sees_trocar=False), ["weights"]),
        (ROW._replace(weights_of="nobody"), ["weights"]),
        (ROW._replace(weights_of="dp_ee_proj"), ["weights"]),
        (
            ROW._replace(weights_of="mine", action_space="rcm1", hierarchical=True),
            [f"policy in {task}" for task in method_checks.TASKS],
        ),
        (methods.METHODS["stardiff_pose"]._replace(weights_of="mine"), []),
        (methods.METHODS["stardiff_wrist"]._replace(weights_of="mine"), []),
    ],
)
def test_methods(monkeypatch, row, expected):
    monkeypatch.setitem(methods.METHODS.registry.built_in, "mine", row._replace(label="mine"))
    assert faults(method_checks.check("mine", 1)) == expected


LONGER = rcm.LARGE_NEEDLE_DRIVER._replace(clevis=0.0092)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, []),
        ({"wrist": LONGER}, ["wrist"]),
        ({"wrist_joints": ("yaw", "pitch")}, ["wrist"]),
        ({"shaft": "stem"}, ["record"]),
    ],
)
def test_a_tool_with_a_wrist(monkeypatch, changes, expected):
    tool = registries.tools.get("needle_driver")._replace(**changes)
    model = tool_checks._compile("needle_driver")[1]
    monkeypatch.setattr(tool_checks, "_compile", lambda name: (tool, model))
    assert faults(tool_checks.check("needle_driver", 1)) == expected


RCM4 = rcm.ACTION_SPACES["rcm4"]


def shallow(parts, frame):
    """Decodes without the trocar: straight down."""
    pose = actions._decode_rcm4(parts, frame)
    return pose._replace(R=jnp.broadcast_to(actions._down(pose.p.dtype), pose.R.shape))


def stretched(action, *trocar):
    pose, valid = RCM4.decode(action, *trocar)
    return pose._replace(R=1.1 * pose.R), valid


SPACES = {
    "sound": ({}, []),
    "slices": ({"slices": {"roll": slice(0, 1), "p": slice(0, 3)}}, ["record"]),
    "no parts": ({"dim": 5}, ["record", "encode, decode"]),
    "one result": ({"decode": lambda *of: RCM4.decode(*of)[0]}, ["encode, decode"]),
    "off": (
        {"decode": actions.make_space("mine", None, shallow, roll=1, p=3).decode},
        ["there and back", "manifold"],
    ),
    "stretched": ({"decode": stretched}, ["there and back", "any action", "total"]),
    "always valid": (
        {"decode": lambda *of: (RCM4.decode(*of)[0], jnp.ones(of[0].shape[:-1], bool))},
        ["total"],
    ),
}


@pytest.mark.parametrize("name", SPACES)
def test_action_spaces(monkeypatch, name):
    changes, expected = SPACES[name]
    monkeypatch.setitem(actions._BUILT_IN, "mine", RCM4._replace(name="mine", **changes))
    assert faults(action_spaces.check("mine", 1)) == expected


SMOKE = presets.PRESETS["smoke"]


def changed(section, **values):
    part = dataclasses.replace(getattr(SMOKE, section), **values)
    return dataclasses.replace(SMOKE, **{section: part})


@pytest.mark.parametrize(
    ("preset", "expected"),
    [
        (SMOKE, []),
        (changed("train", learning_rate=-1.0), ["ranges"]),
        (changed("scene", task="peg_transfr"), ["scene"]),
        (changed("policy", execute=17), ["methods"]),
        (changed("policy", encoder="resnet19"), ["methods"]),
    ],
)
def test_presets(monkeypatch, preset, expected):
    monkeypatch.setitem(presets._BUILT_IN, "mine", preset)
    assert faults(preset_checks.check("mine", 1)) == expected


class Pooled(nn.Module):
    """A trunk of one convolution, with a fault by name."""

    width: int = 16
    dtype: type = jnp.float32
    fault: str = ""

    @nn.compact
    def __call__(self, image):
        """Returns maps `[N, h / 4, w / 4, width]`."""
        x = nn.Conv(self.width, (4, 4), (4, 4), dtype=self.dtype)(image.astype(self.dtype))
        if self.fault == "batch":
            x = x - x.mean(0)
        if self.fault == "flat":
            return x.reshape(len(x), -1)
        return x * jnp.nan if self.fault == "nan" else x


def trunk(fault="", cell=4):
    return Trunk(lambda width, dtype, name=None: Pooled(width, dtype, fault, name=name), 16, cell)


@pytest.mark.parametrize(
    ("made", "expected"),
    [
        (trunk(), []),
        (trunk(cell=8), ["maps"]),
        (trunk("batch"), ["features"]),
        (trunk("nan"), ["features"]),
        (trunk("flat"), ["maps"]),
        (trunk()._replace(width=0), ["record"]),
        (trunk()._replace(make=lambda width: None), ["maps"]),
    ],
)
def test_encoders(monkeypatch, made, expected):
    monkeypatch.setitem(ENCODERS.built_in, "mine", made)
    assert faults(encoders.check("mine", 1)) == expected


class Still:
    """Holds the tip; its plans have faults by name."""

    def __init__(self, fault):
        self.fault, self.calls = fault, 0

    def act(self, observation):
        """Returns the measured row, some times."""
        self.calls += 1
        row = np.array(observation["observation/state"])
        if self.fault == "raises":
            raise ZeroDivisionError
        if self.fault == "memory":
            row[0] += 1e-3 * self.calls
        if self.fault == "far":
            row[0] += 0.1
        length = self.calls if self.fault == "lengths" else 2
        return np.repeat(row[None], length, 0)


@pytest.mark.parametrize(
    ("fault", "subject", "status"),
    [
        ("", "", ""),
        ("raises", "plan", base.FAILED),
        ("lengths", "calls", base.FAILED),
        ("memory", "repeatable", base.NOTE),
        ("far", "command", base.FAILED),
    ],
)
def test_policies(monkeypatch, fault, subject, status):
    made = ExternalPolicy("holds", "reach", lambda: Still(fault), observation="state")
    monkeypatch.setitem(POLICIES.built_in, "mine", made)
    odd = [check for check in policy_checks.check("mine", 1) if check.status != base.OK]
    assert [(check.subject, check.status) for check in odd] == [(subject, status)] * bool(fault)


def test_a_policy_without_act(monkeypatch):
    made = ExternalPolicy("nothing", "reach", object, observation="state")
    monkeypatch.setitem(POLICIES.built_in, "mine", made)
    assert faults(policy_checks.check("mine", 1)) == ["make"]
