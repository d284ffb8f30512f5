"""Evaluations: their trials are those of the seed, and neither chunks nor kills change them."""

import json
import os
import pathlib
import shutil
import subprocess
import sys
from typing import Any

import fakes
import jax
import jax.numpy as jnp
import kill
import mistakes
import numpy as np
import pytest
import stubs

from starjax import rcm
from starjax.core.methods import METHODS
from starjax.data import normalizer
from starjax.evaluation import evaluate, recorded, statistics
from starjax.evaluation import trials as tables
from starjax.policies import policy as policies
from starjax.runtime import files
from starjax.sim.rollouts import agent, chunks, engine, placement
from starjax.sim.rollouts.episodes import Episode
from starjax.sim.rollouts.placement import DeviceLayout

TROCARS = stubs.trocars(0, 4, 8)
SETTINGS = evaluate.EvaluationSettings(trials=2, seed=0, time_limit_s=1.0)
GOLDEN = pathlib.Path(__file__).parents[1] / "golden" / "evaluation"


def run(
    directory,
    sample=None,
    params=None,
    env=None,
    stats=1.0,
    report=lambda _: None,
    obs_horizon=2,
    execute=4,
    lanes=6,
    devices=None,
    trocars=TROCARS,
    **changed,
):
    stub, weights = stubs.make_policy(width=32)
    return evaluate.evaluate(
        directory,
        env or stubs.make_env(),
        agent.from_policy(sample or stub, obs_horizon, execute),
        (weights if params is None else params, jnp.float32(stats)),
        trocars,
        SETTINGS._replace(**changed),
        layout=DeviceLayout(lanes, devices),
        report=report,
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
    ours, theirs = tables.columns(a), tables.columns(b)
    assert ours.keys() == theirs.keys()
    for name, column in ours.items():
        np.testing.assert_array_equal(column, theirs[name], name)


def test_outcomes_are_those_of_the_environment(whole):
    _, found = whole
    assert found.success.any() and not found.success.all() and found.invalid.any()
    assert not (found.success & found.invalid).any()
    np.testing.assert_array_equal(found.trocar, [0, 0, 1, 1, 2, 2])
    np.testing.assert_array_equal(found.trial, [0, 1, 0, 1, 0, 1])
    np.testing.assert_array_equal(found.radius, np.repeat(TROCARS.radius, 2, axis=0))
    timeout = ~found.success & ~found.invalid
    assert (found.steps[timeout] == 30).all() and (found.steps[~timeout] < 30).all()


@pytest.mark.parametrize("chunk", [2, 3])
def test_the_chunk_does_not_change_a_bit(whole, tmp_path, chunk):
    assert_same(run(tmp_path, chunk=chunk), whole[1])


def test_the_same_seed_gives_the_same_trials(whole):
    """Those of the code at f5ed409, with the stub of its day."""
    before = np.load(GOLDEN / "table.npz")
    ours = tables.columns(whole[1])
    for name in before.files:
        mine = ours.get(name, ours.get(f"labels.{name}"))
        mine = mine[:, 0] if name in rcm.Trocar._fields else mine
        np.testing.assert_array_equal(mine, before[name], name)


@pytest.mark.slow
def test_the_chunk_does_not_change_a_bit_of_a_network(tmp_path):
    """The same with convolutions and matrix products, whose last bits may depend on the batch."""
    row = METHODS["stardiff"]
    policy = policies.make(row, fakes.TINY, fakes.TASK)
    dataset = fakes.dataset(seed=0, demos=4, length=20, image_size=fakes.TINY.image_size)
    stats = normalizer.fit(row, fakes.TASK, dataset, np.arange(80))
    params = jax.jit(policy.init)(jax.random.key(0))
    found = [
        evaluate.evaluate(
            tmp_path / str(chunk),
            stubs.make_env(),
            agent.from_policy(policy.sample, 2, 4),
            (params, stats),
            TROCARS,
            SETTINGS._replace(chunk=chunk, video_trials=6),
            layout=DeviceLayout(6),
        )
        for chunk in (2, 3, 6)
    ]
    assert_same(found[0], found[2])
    assert_same(found[1], found[2])
    paths = [(tmp_path / chunk / "recorded.npz").read_bytes() for chunk in "236"]
    assert paths[0] == paths[1] == paths[2]


def test_trials_depend_on_the_seed_and_on_nothing_else(whole, tmp_path):
    assert_same(run(tmp_path / "a", chunk=6, trials=1, trocars=TROCARS), _first_trials(whole[1]))
    other = run(tmp_path / "b", chunk=6, seed=1)
    assert not np.array_equal(other.steps, whole[1].steps)


def _first_trials(found):
    return tables.select(found, found.trial == 0)


def test_kills_leave_no_trace(tmp_path):
    survived = kill.survive(__file__, "job", tmp_path, kills=6)
    assert survived.kills == 6
    assert survived.killed == survived.whole
    assert {"trials.json", "recorded.npz", "chunk_0005.npz"} <= set(survived.whole)


def test_finished_chunks_are_not_run_again(tmp_path, whole, monkeypatch):
    first = run(tmp_path, chunk=3)
    monkeypatch.setattr(engine, "make", lambda *_: None)
    assert_same(run(tmp_path, chunk=3), first)
    assert_same(run(tmp_path), first)  # content of the folder


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
        {"trocars": stubs.trocars(0, 4, 9)},
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


@pytest.mark.parametrize("what", ["model", "versions"])
def test_another_simulator_starts_afresh(tmp_path, whole, monkeypatch, what):
    run(tmp_path, chunk=3)
    change = {"model": (evaluate.schema, "model_hash"), "versions": (evaluate.xla, "versions")}
    monkeypatch.setattr(*change[what], lambda *_: "another")
    said = []
    assert_same(run(tmp_path, chunk=3, report=said.append), whole[1])
    assert "2 chunks of another evaluation" in said[0]


@pytest.mark.parametrize("name", ["source", "parts"])
def test_trials_of_other_code_are_refused_unless_its_version_is_another(tmp_path, whole, name):
    shutil.copytree(whole[0], tmp_path, dirs_exist_ok=True)
    plan = json.loads((tmp_path / "plan.json").read_text())
    task, *_ = plan["source"]
    plan[name][task] = 0
    (tmp_path / "plan.json").write_text(json.dumps(plan))
    if name == "source":
        with mistakes.of(task):
            run(tmp_path, video_trials=4)
    else:
        assert_same(run(tmp_path, video_trials=4), whole[1])


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
    assert said == [f"{first} is damaged: it holds other trials; made again"]


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
    group = [*zip(whole[1].trocar.tolist(), whole[1].trial.tolist(), strict=True)]
    none = np.zeros(len(group), bool)
    parts = evaluate._parts(tmp_path, stubs.make_env(), pytest.fail, group, [slice(6)], none)
    noticed = 0
    for bit in rng.integers(0, 8 * len(good), 200):
        bad = bytearray(good)
        bad[bit // 8] ^= 1 << (bit % 8)
        path.write_bytes(bad)
        found = chunks._read(parts, 0, lambda _: None)
        noticed += found is None
        if found is not None:  # a byte that means nothing, such as a date
            assert_same(tables.from_columns(found), whole[1])
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
        path = kept["p_world_tip"][row, :, 0]
        assert np.isfinite(path[:length]).all() and np.isnan(path[length:]).all()
        speed = np.linalg.norm(np.diff(path[:length], axis=0), axis=-1)
        assert (speed <= stubs.SPEED + 1e-6).all()
        np.testing.assert_allclose(kept["qpos"][row, :length, :3], path[:length])
        for name in ("source", "target"):
            assert kept[f"labels.{name}"][row] == found.labels[name][at]
        start = found.steps[:at].sum()
        np.testing.assert_allclose(
            1e3 * kept["rcm_error"][row, :length, 0],
            found.rcm_error_mm[start : start + length],
            rtol=1e-3,
        )
        np.testing.assert_allclose(1e3 * found.rcm_max[at], recorded_max(kept, row), rtol=1e-6)


def test_recorded_trocars_are_those_of_the_trials(whole):
    with np.load(whole[0] / "recorded.npz", allow_pickle=False) as kept:
        places = np.asarray(rcm.trocar_position(TROCARS, stubs.P_WORLD_REF[:1]))
        np.testing.assert_allclose(kept["p_world_trocar"], places[kept["trocar"]], atol=1e-7)


def test_recorded_trajectories_are_the_golden_ones(whole):
    ours, theirs = (recorded.read(x / "recorded.npz") for x in (whole[0], GOLDEN))
    assert len(ours) == len(theirs) == 4
    for one, other in zip(ours, theirs, strict=True):
        assert one.labels == other.labels and (one.trocar, one.trial) == (other.trocar, other.trial)
        for name in ("p_world_tip", "p_world_trocar", "rcm_error", "qpos"):
            np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=1e-7)


def test_every_trial_that_diverged_is_kept_to_its_last_sound_state(whole):
    directory, found = whole
    kept = recorded.read(directory / "invalid.npz")
    rows = np.flatnonzero(found.invalid)
    assert len(rows) and [(x.trocar, x.trial) for x in kept] == [
        (found.trocar[row], found.trial[row]) for row in rows
    ]
    for row, track in zip(rows, kept, strict=True):
        assert len(track.qpos) == found.steps[row] and np.isfinite(track.qpos).all()
        assert track.labels["source"] == found.labels["source"][row]


def test_an_evaluation_without_diverged_trials_has_no_file_of_them(tmp_path):
    found = run(tmp_path, trials=1, chunk=6)
    assert (tmp_path / "invalid.npz").exists() == found.invalid.any()


def recorded_max(kept, row):
    return 1e3 * np.nanmax(kept["rcm_error"][row])


def test_few_of_many_trocars_are_recorded_evenly():
    mask = recorded.choose(100, 2, 5).reshape(100, 2)
    assert list(np.flatnonzero(mask[:, 0])) == [0, 25, 50, 74, 99] and not mask[:, 1].any()
    assert not recorded.choose(3, 2, 0).any()
    assert recorded.choose(3, 2, 50).all()


def test_commanded_error_counts_executed_commands_only(whole):
    """The stub's commands keep R = 1, so the error of a command is its distance to the vertical."""
    directory, found = whole
    assert (found.rcm_commanded_max > 1e-4).all()
    for trial in recorded.read(directory / "recorded.npz"):
        # Where the plan is followed exactly, the tip has been at every command that was executed.
        aside = trial.p_world_tip[:, 0, :2] - trial.p_world_trocar[0, :2]
        at = np.flatnonzero((found.trocar == trial.trocar) & (found.trial == trial.trial))[0]
        far = np.linalg.norm(aside, axis=-1).max()
        np.testing.assert_allclose(found.rcm_commanded_max[at], far, atol=2e-3)


def test_errors_of_several_arms_are_those_of_the_worst(tmp_path):
    trocars = stubs.trocars(0, 4, arms=2)
    env = stubs.make_env(arms=2, unlucky=0.0)
    found = run(tmp_path, env=env, trocars=trocars, video_trials=4)
    assert found.radius.shape == (4, 2)
    for trial in recorded.read(tmp_path / "recorded.npz"):
        at = np.flatnonzero((found.trocar == trial.trocar) & (found.trial == trial.trial))[0]
        assert trial.rcm_error is not None and trial.rcm_error.shape[1] == 2
        np.testing.assert_allclose(found.rcm_max[at], trial.rcm_error.max(), rtol=1e-6)
        worst = trial.rcm_error.max(axis=1)
        np.testing.assert_allclose(found.rcm_mean[at], worst.mean(), rtol=1e-5)


def test_a_trial_is_safe_if_its_executed_error_stayed_small():
    executed = [[1e-3, 1.8e-3], [1e-3, 1.9e-3], [9.0, 9.0]]
    within = [[1.9e-3, 1.8e-3], [1e-3, 2.1e-3], [9.0, 9.0]]
    outcomes = [
        {"success": True, "collided": False, "invalid": False, "loose": True},
        {"success": True, "collided": True, "invalid": False, "loose": False},
        {"success": False, "collided": False, "invalid": True, "loose": False},
    ]
    same = {"trocar": 0, "radius": [0.0], "polar": [0.0], "azimuth": [0.0], "trial": 0}
    same |= {"length": 2, "lost": False, "stage": 1, "labels": {"source": 3}}
    found = tables.from_episodes(
        [
            Episode(
                {**same, **outcome},
                {
                    "rcm_error": [np.float32(at_ends)[:, None]],
                    "rcm_error_within": [np.float32(inside)[:, None]],
                    "rcm_error_commanded": [np.zeros((2, 1), np.float32)],
                },
            )
            for outcome, at_ends, inside in zip(outcomes, executed, within)
        ]
    )
    np.testing.assert_array_equal(found.safe, [True, False, False])
    np.testing.assert_array_equal(found.loose, [True, False, False])
    np.testing.assert_array_equal(found.collided, [False, True, False])
    np.testing.assert_allclose(found.rcm_max, [1.8e-3, 1.9e-3, 9.0])
    np.testing.assert_allclose(found.rcm_mean, [1.4e-3, 1.45e-3, 9.0])
    np.testing.assert_allclose(found.rcm_within_max, [1.9e-3, 2.1e-3, 9.0])
    np.testing.assert_allclose(found.rcm_within_mm[:4], [1.9, 1.8, 1, 2.1], rtol=1e-3)
    assert found.labels["source"].tolist() == [3, 3, 3]


@pytest.mark.parametrize(
    ("bad", "name"),
    [
        ({"trials": 0}, "trials"),
        ({"time_limit_s": 0.0}, "time_limit_s"),
        ({"chunk": -1}, "chunk"),
        ({"lanes": -1}, "lanes"),
        ({"video_trials": -1}, "video_trials"),
        ({"trocars": rcm.Trocar(*np.full((3, 1, 1), 80.0))}, "trocar.polar"),
        ({"trocars": rcm.Trocar(*np.zeros((3, 0, 1)))}, "trocars"),
        ({"trocars": stubs.trocars(0, arms=2)}, "trocars"),
    ],
)
def test_bad_arguments_are_named_and_cost_nothing(tmp_path, bad, name):
    (tmp_path / "chunk_0000.npz").write_bytes(b"of an earlier evaluation")
    with pytest.raises(ValueError, match=name):
        run(tmp_path, **bad)
    assert (tmp_path / "chunk_0000.npz").exists()


_DEVICES = """
import sys, json, pathlib
import jax, numpy as np
import test_evaluate
out = pathlib.Path(sys.argv[1])
assert len(jax.devices()) == 2
one = test_evaluate.run(out / "1", lanes=2, devices=jax.devices()[:1])
two = test_evaluate.run(out / "2", lanes=2, devices=jax.devices())
test_evaluate.assert_same(one, two)
from starjax.evaluation import evaluate
evaluate.lanes_per_device = lambda _, trials: trials
test_evaluate.run(out / "3", lanes=0, devices=jax.devices())
from starjax.sim.rollouts import agent, placement
split = [placement.LANE], placement.LANE
last = placement.split(lambda x: x + 1, jax.devices()[1:], *split)(np.ones(2))
assert last.devices() == {jax.devices()[1]}
import stubs, kill
from starjax.data import demos, schema
for count in (1, 2):
    demos.collect(
        out / f"demos{count}", stubs.make_env(), agent.from_single(stubs.EXPERT),
        test_evaluate.TROCARS, schema.DemoSettings(per_trocar=2, seed=0, max_steps=100),
        layout=placement.DeviceLayout(4, jax.devices()[:count]))
assert kill.tree(out / "demos1") == kill.tree(out / "demos2")
print("same")
"""


def test_two_devices_give_the_same_bits(tmp_path):
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
        assert placement.devices() == expected


def test_a_folder_in_use_is_refused(tmp_path):
    with files.lock(tmp_path), pytest.raises(files.StorageError, match="in use by"):
        run(tmp_path)
