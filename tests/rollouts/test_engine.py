"""Closed-loop rollouts: what a trial is, and that neither its neighbours nor kills change it."""

import json
import shutil
import subprocess
import sys
import types
from typing import Any

import fakes
import jax
import jax.numpy as jnp
import kill
import numpy as np
import pytest
import stubs

from starjax import rcm
from starjax.data import normalizer
from starjax.evaluation import evaluate, recorded, statistics
from starjax.evaluation import trials as table
from starjax.methods import METHODS
from starjax.policies import policy as policies
from starjax.rollouts import engine
from starjax.rollouts import placement as splitting
from starjax.runtime import files
from starjax.types import Command, Pose

TROCARS = rcm.Trocar(*(field[[0, 4, 8]] for field in rcm.TROCARS))
KWARGS = {"trials": 2, "seed": 0, "obs_horizon": 2, "execute": 4, "time_limit_s": 1.0, "lanes": 6}


def run(directory, policy=None, params=None, env=None, stats=1.0, report=lambda _: None, **kwargs):
    stub, weights = stubs.make_policy(width=32)
    return evaluate.evaluate(
        directory,
        env or stubs.make_env(),
        policy or stub,
        weights if params is None else params,
        jnp.float32(stats),
        kwargs.pop("trocars", TROCARS),
        report=report,
        **{**KWARGS, **kwargs},
    )


def job(directory):
    """What the kill test runs."""
    found = run(directory, chunk=1, video_trials=2)
    seen = np.ones(len(found.trocar), bool)
    files.write_json(directory / "trials.json", statistics.trials(found, seen, 0))


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    directory = tmp_path_factory.mktemp("evaluation")
    return directory, run(directory, chunk=6, video_trials=4)


def assert_same(a, b):
    for name in table.Table._fields:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), name)


def test_outcomes_are_those_of_the_environment(whole):
    _, found = whole
    assert found.success.any() and not found.success.all() and found.invalid.any()
    assert not (found.success & found.invalid).any()
    np.testing.assert_array_equal(found.trocar, [0, 0, 1, 1, 2, 2])
    np.testing.assert_array_equal(found.trial, [0, 1, 0, 1, 0, 1])
    np.testing.assert_array_equal(found.radius, np.repeat(TROCARS.radius, 2))
    timeout = ~found.success & ~found.invalid
    assert (found.steps[timeout] == 30).all() and (found.steps[~timeout] < 30).all()


@pytest.mark.parametrize("chunk", [2, 3])
def test_the_chunk_does_not_change_a_bit(whole, tmp_path, chunk):
    assert_same(run(tmp_path, chunk=chunk), whole[1])


def test_the_chunk_does_not_change_a_bit_of_a_network(tmp_path):
    """The same with convolutions and matrix products, whose last bits may depend on the batch."""
    row, p_world_ref = METHODS["stardiff"], stubs.P_WORLD_REF
    policy = policies.make(row, fakes.TINY, p_world_ref)
    dataset = fakes.dataset(seed=0, demos=4, length=20, image_size=fakes.TINY.image_size)
    stats = normalizer.fit(row, dataset, p_world_ref, np.arange(80))
    params = jax.jit(policy.init)(jax.random.key(0))
    tables = [
        evaluate.evaluate(
            tmp_path / str(chunk),
            stubs.make_env(),
            policy,
            params,
            stats,
            TROCARS,
            chunk=chunk,
            video_trials=6,
            **KWARGS,
        )
        for chunk in (2, 3, 6)
    ]
    assert_same(tables[0], tables[2])
    assert_same(tables[1], tables[2])
    paths = [(tmp_path / chunk / "recorded.npz").read_bytes() for chunk in "236"]
    assert paths[0] == paths[1] == paths[2]


def test_trials_depend_on_the_seed_and_on_nothing_else(whole, tmp_path):
    assert_same(run(tmp_path / "a", chunk=6, trials=1, trocars=TROCARS), _first_trials(whole[1]))
    other = run(tmp_path / "b", chunk=6, seed=1)
    assert not np.array_equal(other.steps, whole[1].steps)


def _first_trials(found):
    return table.select(found, found.trial == 0)


def test_kills_leave_no_trace(tmp_path):
    survived = kill.survive(__file__, "job", tmp_path, kills=10)
    assert survived.kills == 10
    assert survived.killed == survived.whole
    assert {"trials.json", "recorded.npz", "chunk_0005.npz"} <= set(survived.whole)


def test_finished_chunks_are_not_run_again(tmp_path, whole, monkeypatch):
    first = run(tmp_path, chunk=3)
    monkeypatch.setattr(engine, "make", lambda *_: None)
    assert_same(run(tmp_path, chunk=3), first)
    assert_same(run(tmp_path), first)  # what the folder has


def test_other_weights_start_afresh(tmp_path, whole):
    run(tmp_path, chunk=3)
    _, params = stubs.make_policy(width=32)
    said = []
    other = run(tmp_path, chunk=3, params=[2.0 * p for p in params], report=said.append)
    assert "2 chunks of another evaluation" in said[0]
    assert not np.array_equal(other.rcm_error_mm, whole[1].rcm_error_mm)


@pytest.mark.parametrize(
    "other",
    [
        {"seed": 1},
        {"trocars": rcm.Trocar(*(field[[0, 4, 9]] for field in rcm.TROCARS))},
        {"time_limit_s": 0.5},
        {"execute": 3},
        {"stats": 2.0},
    ],
    ids=lambda other: next(iter(other)),
)
def test_trials_of_other_settings_are_not_taken_for_these(whole, tmp_path, monkeypatch, other):
    shutil.copytree(whole[0], tmp_path, dirs_exist_ok=True)

    def trials(*_):
        pytest.fail("begins afresh")

    monkeypatch.setattr(engine, "make", lambda *_: trials)
    said = []
    with pytest.raises(pytest.fail.Exception, match="begins afresh"):
        run(tmp_path, chunk=6, video_trials=4, report=said.append, **other)
    assert "another evaluation" in said[0]


@pytest.mark.parametrize("what", ["scene", "versions"])
def test_another_simulator_starts_afresh(tmp_path, whole, monkeypatch, what):
    run(tmp_path, chunk=3)
    change = {"scene": (evaluate.demos, "scene_hash"), "versions": (evaluate.xla, "versions")}
    monkeypatch.setattr(*change[what], lambda *_: "another")
    said = []
    assert_same(run(tmp_path, chunk=3, report=said.append), whole[1])
    assert "2 chunks of another evaluation" in said[0]


def test_a_damaged_chunk_is_named_and_run_again(tmp_path, whole):
    first = run(tmp_path, chunk=3)
    path = tmp_path / "chunk_0001.npz"
    good = path.read_bytes()
    for bad in (good[:-50], b"", good.replace(b"success", b"succass")):
        path.write_bytes(bad)
        said = []
        assert_same(run(tmp_path, chunk=3, report=said.append), first)
        assert "chunk_0001.npz" in said[0]
        assert path.read_bytes() == good


def test_a_chunk_of_other_trials_is_named_and_run_again(tmp_path):
    found = run(tmp_path, chunk=3)
    first, second = sorted(tmp_path.glob("chunk_*.npz"))
    shutil.copy(second, first)
    said = []
    assert_same(run(tmp_path, chunk=3, report=said.append), found)
    assert said == [f"{first} holds other trials; evaluated again"]


def test_a_plan_that_does_not_say_its_chunk_is_another(tmp_path, whole):
    shutil.copytree(whole[0], tmp_path, dirs_exist_ok=True)
    plan = json.loads((tmp_path / "plan.json").read_text())
    del plan["chunk"]
    (tmp_path / "plan.json").write_text(json.dumps(plan))
    assert_same(run(tmp_path, video_trials=4), whole[1])


def test_a_damaged_plan_is_named_and_written_again(tmp_path, whole):
    first = run(tmp_path, chunk=6)
    plan = tmp_path / "plan.json"
    good = plan.read_bytes()
    plan.write_bytes(good[:-9])
    said = []
    assert_same(run(tmp_path, chunk=6, report=said.append), first)
    assert "plan.json is damaged" in said[0] and plan.read_bytes() == good


def test_no_flipped_bit_of_a_chunk_gets_into_the_table(tmp_path, whole):
    run(tmp_path, chunk=6)
    path = tmp_path / "chunk_0000.npz"
    good = path.read_bytes()
    rng = np.random.default_rng(0)
    noticed = 0
    for bit in rng.integers(0, 8 * len(good), 200):
        bad = bytearray(good)
        bad[bit // 8] ^= 1 << (bit % 8)
        path.write_bytes(bad)
        found = evaluate._read(path, whole[1].trocar, whole[1].trial, lambda _: None)
        noticed += found is None
        if found is not None:  # a byte that means nothing, such as a date
            assert_same(found[0], whole[1])
    assert noticed > 100


def test_recorded_trajectories_are_those_of_the_trials(whole):
    directory, found = whole
    with np.load(directory / "recorded.npz", allow_pickle=False) as archive:
        kept = dict(archive)
    assert sorted(zip(kept["trocar"], kept["trial"])) == [(0, 0), (0, 1), (1, 0), (2, 0)]
    for row, (trocar, trial) in enumerate(zip(kept["trocar"], kept["trial"])):
        at = np.flatnonzero((found.trocar == trocar) & (found.trial == trial))[0]
        length = kept["length"][row]
        assert length == found.steps[at]
        path = kept["p_world_tip"][row]
        assert np.isfinite(path[:length]).all() and np.isnan(path[length:]).all()
        speed = np.linalg.norm(np.diff(path[:length], axis=0), axis=-1)
        assert (speed <= stubs.SPEED + 1e-6).all()
        np.testing.assert_allclose(kept["qpos"][row, :length, :3], path[:length])
        assert kept["target_peg"][row] == found.target[at]
        assert kept["source_peg"][row] == found.source[at]
        start = found.steps[:at].sum()
        np.testing.assert_allclose(
            1e3 * kept["rcm_error"][row, :length],
            found.rcm_error_mm[start : start + length],
            rtol=1e-3,
        )
        np.testing.assert_allclose(1e3 * found.rcm_max[at], recorded_max(kept, row), rtol=1e-6)


def test_recorded_ports_are_those_of_the_trials(whole):
    with np.load(whole[0] / "recorded.npz", allow_pickle=False) as kept:
        ports = np.asarray(rcm.trocar_position(TROCARS, stubs.P_WORLD_REF))
        np.testing.assert_allclose(kept["p_world_trocar"], ports[kept["trocar"]], atol=1e-7)


def recorded_max(kept, row):
    return 1e3 * np.nanmax(kept["rcm_error"][row])


def test_few_of_many_trocars_are_recorded_evenly():
    mask = recorded.choose(100, 2, 5).reshape(100, 2)
    assert list(np.flatnonzero(mask[:, 0])) == [0, 25, 50, 74, 99] and not mask[:, 1].any()
    assert not recorded.choose(3, 2, 0).any()
    assert recorded.choose(3, 2, 50).all()


def _spy(horizon):
    """A policy whose commands spell the first and last step that it saw, and its plan's key."""

    def sample(params, normalizer, keys, observation, trocar):
        seen = observation.gripper  # what the environment below shows: the step's number
        p = jnp.stack([seen[:, 0], seen[:, -1], jax.vmap(jax.random.uniform)(keys)], -1)
        count = p.shape[0]
        poses = Pose(
            jnp.broadcast_to(jnp.eye(3), (count, horizon, 3, 3)),
            jnp.broadcast_to(p[:, None], (count, horizon, 3)),
        )
        return Command(poses, jnp.broadcast_to(jnp.arange(float(horizon)), (count, horizon)))

    return stubs.Policy(sample)


def _counting():
    """An environment that never ends and logs the commands that it gets in qpos."""
    base = stubs.make_env(unlucky=0.0)

    def reset(key, params):
        state = base.reset(key, params)
        return state.replace(sim=stubs.Physics(jnp.zeros(4)), gripper=jnp.zeros(()))

    def step(state, command):
        log = jnp.concatenate([command.pose.p, command.gripper[None]])
        number = state.step + 1
        return state.replace(
            sim=stubs.Physics(log), step=number, gripper=number.astype(jnp.float32)
        )

    return base._replace(reset=reset, step=step)


@pytest.mark.parametrize("horizon", [1, 2, 3])
def test_history_and_plans_follow_the_paper(tmp_path, horizon):
    """Observes steps t - O + 1 .. t, executes the plan's first commands, then plans anew."""
    run(
        tmp_path,
        policy=_spy(6),
        env=_counting(),
        obs_horizon=horizon,
        trocars=rcm.Trocar(*(f[:1] for f in rcm.TROCARS)),
        trials=1,
        time_limit_s=10 / 30,
        video_trials=1,
    )
    with np.load(tmp_path / "recorded.npz", allow_pickle=False) as archive:
        log = archive["qpos"][0]
    t = np.array([0, 0, 0, 0, 4, 4, 4, 4, 8, 8])
    np.testing.assert_array_equal(log[:, 3], [0, 1, 2, 3, 0, 1, 2, 3, 0, 1])
    np.testing.assert_array_equal(log[:, 1], t)
    np.testing.assert_array_equal(log[:, 0], np.maximum(t - horizon + 1, 0))
    assert len(np.unique(log[:, 2])) == 3  # fresh noise for every plan


def test_commanded_error_counts_executed_commands_only(whole):
    """The stub's commands keep R = 1, so the error of a command is its distance to the vertical."""
    _, found = whole
    assert (found.rcm_commanded_max > 1e-4).all()
    env, (policy, params) = stubs.make_env(), stubs.make_policy(width=32)
    settings = engine.Settings(2, 4, 30)
    trials = engine.Trials(
        trocar=rcm.Trocar(*(f[:1] for f in TROCARS)),
        index=np.zeros(1, np.int32),
        trial=np.zeros(1, np.int32),
        wanted=np.ones(1, bool),
    )
    *_, (_, done) = engine.make(env, policy, settings, 0)(params, jnp.float32(1.0), trials)
    port = np.asarray(rcm.trocar_position(trials.trocar, stubs.P_WORLD_REF))[0]
    # Where the plan is followed exactly, the tip has been at every command that was executed.
    path = done.steps.p_world_tip[: done.length[0], 0]
    far = np.linalg.norm(path[:, :2] - port[:2], axis=-1).max()
    np.testing.assert_allclose(done.commanded_max[0], far, atol=2e-3)


def test_the_commanded_error_of_a_trial_is_its_largest(tmp_path):
    """At step t the command misses the port by 20 mm less 1 mm for each step from the sixth."""

    def sample(params, normalizer, keys, observation, trocar):
        t = observation.gripper[:, -1:] + jnp.arange(6.0)
        aside = 0.02 - 0.001 * jnp.abs(t - 5.0)
        R = jnp.broadcast_to(jnp.eye(3), (*t.shape, 3, 3))
        return Command(Pose(R, aside[..., None] * jnp.array([1.0, 0.0, 0.0])), t)

    centre = rcm.Trocar(*(field[11:] for field in rcm.TROCARS))
    found = run(
        tmp_path,
        policy=stubs.Policy(sample),
        env=_counting(),
        trocars=centre,
        trials=1,
        time_limit_s=10 / 30,
    )
    np.testing.assert_allclose(found.rcm_commanded_max, 0.02, rtol=1e-5)


def test_a_trial_is_safe_if_its_executed_error_stayed_small_and_nothing_if_it_diverged():
    pegs = np.zeros(3, int)
    env = types.SimpleNamespace(
        trocar=rcm.Trocar(*(np.zeros(3, np.float32),) * 3),
        success=np.array([True, True, False]),
        loose=np.array([True, False, True]),
        invalid=np.array([False, False, True]),
        collided=np.array([False, True, False]),
        **dict.fromkeys(("source", "target"), pegs),
    )
    executed = np.array([[1e-3, 1e-3, 0], [1.8e-3, 1.9e-3, 0], [9, 9, 9]], np.float32)
    within = np.array([[1.9e-3, 1e-3, 0], [1.8e-3, 2.1e-3, 0], [9, 9, 9]], np.float32)
    commanded = np.array([5e-3, 0, 0])
    steps = engine.Steps(executed, within, None, None)
    done = engine.Rollouts(env, np.array([2, 2, 2]), commanded, steps)
    found = table.from_rollouts(done, np.arange(3), np.zeros(3, int))
    np.testing.assert_array_equal(found.safe, [True, False, False])
    np.testing.assert_array_equal(found.loose, [True, False, False])
    np.testing.assert_allclose(found.rcm_max, [1.8e-3, 1.9e-3, 0])
    np.testing.assert_allclose(found.rcm_mean, [1.4e-3, 1.45e-3, 0])
    np.testing.assert_array_equal(found.collided, [False, True, False])
    np.testing.assert_allclose(found.rcm_within_max, [1.9e-3, 2.1e-3, 0])
    np.testing.assert_allclose(found.rcm_within_mm, [1.9, 1.8, 1, 2.1, 0, 0], rtol=1e-3)


@pytest.mark.parametrize(
    ("bad", "name"),
    [
        ({"trials": 0}, "trials"),
        ({"time_limit_s": 0.0}, "time_limit_s"),
        ({"chunk": -1}, "chunk"),
        ({"lanes": -1}, "lanes"),
        ({"execute": 0}, "settings"),
        ({"obs_horizon": 6}, "obs_horizon"),
        ({"trocars": rcm.Trocar(0.02, 80.0, 0.0)}, "trocar.polar"),
        ({"trocars": rcm.Trocar(0.02, np.nan, 0.0)}, "trocar.polar"),
        ({"trocars": rcm.Trocar(*np.zeros((3, 0)))}, "trocars: expected .* one trocar or more"),
    ],
)
def test_bad_arguments_are_named_and_cost_nothing(tmp_path, bad, name):
    (tmp_path / "chunk_0000.npz").write_bytes(b"of an earlier evaluation")
    with pytest.raises(ValueError, match=name):
        run(tmp_path, **bad)
    assert (tmp_path / "chunk_0000.npz").exists()


def test_no_more_commands_are_executed_than_planned(tmp_path):
    with pytest.raises(ValueError, match=r"execute: expected at most the \d+ that are planned"):
        run(tmp_path, execute=20)


def test_each_program_is_traced_once(tmp_path):
    traces = []
    policy, _ = stubs.make_policy(width=32)

    def sample(*args):
        traces.append(1)
        return policy.sample(*args)

    run(tmp_path, policy=stubs.Policy(sample), chunk=2, time_limit_s=5.0)
    assert len(traces) == 2  # for the shape of a plan, and for the program


_DEVICES = """
import sys, json, pathlib
import jax, numpy as np
import test_rollout
out = pathlib.Path(sys.argv[1])
assert len(jax.devices()) == 2
one = test_rollout.run(out / "1", lanes=2, devices=jax.devices()[:1])
two = test_rollout.run(out / "2", lanes=2, devices=jax.devices())
test_rollout.assert_same(one, two)
from starjax.evaluation import evaluate
evaluate.lanes_per_device = lambda _, trials: trials
test_rollout.run(out / "3", lanes=0, devices=jax.devices())
from starjax.data import demos, lanes
last = lanes.split(lambda x: x + 1, jax.devices()[1:], [lanes.LANE], lanes.LANE)(np.ones(2))
assert last.devices() == {jax.devices()[1]}
import stubs, kill
for count in (1, 2):
    demos.collect(out / f"demos{count}", stubs.make_env(), stubs.Expert(), test_rollout.TROCARS,
                  per_trocar=2, seed=0, max_steps=100, chunk=4, devices=jax.devices()[:count])
assert kill.tree(out / "demos1") == kill.tree(out / "demos2")
print("same")
"""


def test_two_devices_give_the_same_bits(tmp_path):
    import os
    import pathlib

    here = pathlib.Path(__file__).parent
    flags = os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=2"
    environment = {
        **os.environ,
        "XLA_FLAGS": flags,
        "PYTHONPATH": os.pathsep.join([str(here), *filter(None, sys.path)]),
    }
    done = subprocess.run(
        [sys.executable, "-c", _DEVICES, str(tmp_path)],
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0 and "same" in done.stdout, done.stderr[-3000:]
    plans = [json.loads((tmp_path / n / "plan.json").read_text()) for n in "123"]
    assert [plan["chunk"] for plan in plans] == [2, 4, 6]
    assert plans[2]["lanes"] == 3  # each device has its share


class _Device:
    platform = "gpu"

    def __init__(self, gigabytes):
        self.gigabytes = gigabytes

    def memory_stats(self):
        return {"bytes_limit": self.gigabytes << 30}


@pytest.mark.parametrize(
    ("gigabytes", "trials", "lanes"),
    [(100, 360, 360), (100, 1200, 1200), (100, 1281, 648), (100, 5, 8), (16, 360, 120)],
)
def test_a_gpu_runs_as_many_lanes_as_make_the_fewest_chunks(gigabytes, trials, lanes):
    device: Any = _Device(gigabytes)
    assert evaluate.lanes_per_device(device, trials) == lanes


def test_lanes_are_split_over_all_devices_of_several(monkeypatch):
    for count, expected in ((1, None), (2, [_Device, _Device])):
        monkeypatch.setattr(jax, "local_devices", lambda n=count: [_Device] * n)
        assert splitting.devices() == expected


def test_a_folder_in_use_is_refused(tmp_path):
    with files.lock(tmp_path), pytest.raises(files.StorageError, match="in use by"):
        run(tmp_path)
