"""Policies of this process in place of a server: their greeting, and faults that end a job."""

import types

import numpy as np
import pytest

from starjax.core import errors
from starjax.deploy import connection_pool, external, greeting
from starjax.policies.external import ExternalPolicy

STATE = {"observation/state": np.zeros(8, np.float32)}


def policy(act, **fields):
    made = types.SimpleNamespace(act=act)
    return ExternalPolicy("mine", "reach", lambda: made, observation="state", **fields)


def test_a_policy_is_greeted_as_a_server_is_and_answers_with_actions():
    held = external.LocalConnection("mine", policy(lambda seen: [seen["observation/state"]] * 4))
    hello = greeting.read(held.metadata)
    assert (hello.scene.task, hello.settings.observation, hello.execute) == ("reach", "state", 0)
    assert held.ask(STATE)["actions"].shape == (4, 8)
    assert (
        greeting.read(external.LocalConnection("m", policy(len, execute=3)).metadata).execute == 3
    )


def fails(seen):
    raise IndexError("no such joint")


def test_a_fault_names_the_function_and_ends_the_evaluation():
    with pytest.raises(connection_pool.LostServer) as caught:
        external.LocalConnection("mine", policy(fails)).ask(STATE)
    assert caught.value.argument.startswith("policy mine: act (test_external.py:")
    assert "no such joint" in caught.value.got


@pytest.mark.parametrize("make", [object, lambda: 1 / 0])
def test_a_policy_that_cannot_act_is_refused(make):
    with pytest.raises(errors.UsageError, match="policy mine"):
        external.LocalConnection("mine", policy(None)._replace(make=make))
