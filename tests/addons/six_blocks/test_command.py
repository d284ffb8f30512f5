"""`starjax six-blocks` with a stub of its environment."""

import json
import types

import jax.numpy as jnp
import mistakes
import pytest
import stubs

from starjax.addons.six_blocks import command, environment, task


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty folder, in which commands work."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_exercise_is_for_policies_of_its_task(folder, monkeypatch):
    (folder / "mine.safetensors").touch()
    who = types.SimpleNamespace(env=stubs.make_env(), trained=None)
    monkeypatch.setattr(command.policy_args, "load", lambda path: (who, None))
    with mistakes.of("RUN or --policy", "one for reach"):
        command.main(["--policy", "mine.safetensors"])


def test_it_takes_a_run_or_a_policy(folder):
    with mistakes.of("RUN or --policy", "both"):
        command.main(["x", "--policy", "y"])


def test_the_expert_at_the_exercise(folder, monkeypatch, capsys):
    env, stub = stubs.make_env(), stubs.make_task()._replace(labels=("moved",))
    env = env._replace(
        task=stub, labels=lambda state: {"moved": 5 + state.success.astype(jnp.int32)}
    )
    monkeypatch.setattr(environment, "make", lambda *_, **__: env)
    monkeypatch.setattr(environment, "reset_each_block", lambda agent: agent)
    monkeypatch.setattr(task, "TASK", stub)
    assert command.main(["--trials", "2"]) == 0
    (result,) = folder.rglob("exercise.json")
    found = json.loads(result.read_text())
    assert found["expert"] == "default" and found["complete"]["trials"] == 24
    won = found["complete"]["successes"]
    assert won and found["moved"]["counts"] == [0, 0, 0, 0, 0, 24 - won, won]
    assert 0 < found["seconds"]["median"] <= found["seconds"]["p90"] < found["people"]["limit_s"]
    chunks = {path: path.stat().st_mtime_ns for path in result.parent.rglob("chunk*")}
    assert command.main(["--trials", "2"]) == 0 and chunks
    assert all(path.stat().st_mtime_ns == then for path, then in chunks.items())
    assert f"in {won} of 24 trials" in capsys.readouterr().out
