"""Training as a whole: resume to the last bit, kills, devices, residency, broken losses."""

import dataclasses
import gc
import itertools
import os
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import fakes
import jax
import jax.numpy as jnp
import kill
import mistakes
import numpy as np
import pytest

from starjax.core.methods import METHODS
from starjax.data import windows
from starjax.policies.models.kernels import packed_params
from starjax.runtime import files, precompile, signals
from starjax.training import batches, checkpoint, log, loop, start, state, step

sys.path.insert(0, str(Path(__file__).parent))
import jobs  # in this folder, for processes to run


def leaves(tree):
    return [
        np.asarray(jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x)
        for x in jax.tree.leaves(tree)
    ]


def assert_same_bytes(a, b):
    for x, y in zip(leaves(a), leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """One uninterrupted run: its directory and result."""
    directory = tmp_path_factory.mktemp("whole")
    traces = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop.policies, "make", lambda *_: jobs._quadratic_policy())
        traced = step.resident_step
        patch.setattr(step, "resident_step", lambda *a: traces.append(0) or traced(*a))
        result = jobs.train(directory)
    assert len(traces) == 1
    return directory, result


def test_a_thread_trains_the_same_weights(tmp_path, monkeypatch):
    """As in a notebook that stays usable; Python handles no signals there."""
    monkeypatch.setattr(loop.policies, "make", lambda *_, **__: jobs._quadratic_policy())

    def train(directory):
        with signals.stop_signals() as should_stop:
            return jobs.train(directory, should_stop=should_stop).state

    with ThreadPoolExecutor(1) as pool:
        found = pool.submit(train, tmp_path / "thread").result()
    assert_same_bytes(found, train(tmp_path / "main"))


def test_a_run_leaves_its_log_and_checkpoints(whole):
    directory, result = whole
    lines = log.read(directory / "metrics.jsonl")
    train = [line["step"] for line in lines if line["kind"] == "train"]
    held = [line for line in lines if line["kind"] == "holdout"]
    assert train == list(range(3, 13, 3))
    assert [line["step"] for line in held] == list(range(4, 13, 4))
    assert {"position_error_mm", "roll_error_deg", "gripper_error"} <= held[0].keys()
    assert result.holdout == {k: v for k, v in held[-1].items() if k not in ("step", "kind")}
    first = next(line for line in lines if line["kind"] == "train")
    assert {"loss", "gradient_norm", "learning_rate", "skipped"} <= first.keys()
    assert checkpoint.steps(directory / "checkpoints") == [8, 12]
    assert int(result.state.step) == 12 and result.skipped == 0


def test_statistics_are_of_the_action_space_that_is_trained(monkeypatch, tmp_path):
    def fit(row, *_):
        raise InterruptedError(row.action_space)  # nothing else is asked of it

    monkeypatch.setattr(loop.normalizer, "fit", fit)
    fixed = dataclasses.replace(fakes.TINY, trocar_yaw="fixed")
    given = METHODS["dp_rcm2"], fixed, jobs.SETTINGS, fakes.dataset(seed=0), fakes.TASK
    with pytest.raises(InterruptedError, match="rcm2_fixed_yaw"):
        loop.run(*given, tmp_path, 0)


@pytest.fixture
def quick(monkeypatch):
    """A policy that compiles at once."""
    policy = jobs._quadratic_policy()
    monkeypatch.setattr(loop.policies, "make", lambda *_: policy)
    return policy


def test_demonstrations_kept_out_are_neither_trained_on_nor_fitted(quick, monkeypatch, tmp_path):
    fitted, drawn, fit, place = [], [], loop.normalizer.fit, batches.on_devices
    monkeypatch.setattr(loop.normalizer, "fit", lambda *a: fitted.append(a[3]) or fit(*a))
    monkeypatch.setattr(batches, "on_devices", lambda *a, **k: drawn.append(a[2]) or place(*a, **k))
    jobs.train(tmp_path, dataclasses.replace(jobs.SETTINGS, steps=1))
    dataset = fakes.dataset(seed=0)
    train, held = windows.split_holdout(
        dataset.start, dataset.length, dataset.trocar, jobs.SETTINGS.holdout_demos
    )
    assert len(held) and not np.isin(held, train).any()
    np.testing.assert_array_equal(fitted, [train])
    np.testing.assert_array_equal(drawn, [train])


def test_losses_that_are_all_broken_end_the_training(quick, monkeypatch, tmp_path):
    broken = quick._replace(loss=lambda *a: (jnp.nan * quick.loss(*a)[0], {}))
    monkeypatch.setattr(loop.policies, "make", lambda *_: broken)
    with mistakes.of("train.learning_rate", "none finite in 3 steps before step 3"):
        jobs.train(tmp_path)


def test_a_full_disk_at_a_line_of_the_log_is_told(tmp_path):
    with pytest.raises(files.StorageError, match=r"cannot write .*log: .*last checkpoint"):
        log.append(tmp_path / "missing" / "log", 3, "train", {})


def test_a_skipped_step_does_not_move_the_learning_rate(quick, monkeypatch, tmp_path):
    def prepare(stats, key, batch):
        observation, p = quick.prepare(stats, key, batch)
        return observation, jnp.where(jax.random.bernoulli(key), jnp.nan, p)

    broken = quick._replace(prepare=prepare)
    monkeypatch.setattr(loop.policies, "make", lambda *_: broken)
    result = jobs.train(tmp_path)
    used = int(result.state.opt_state[0].count)
    lines = [x for x in log.read(tmp_path / "metrics.jsonl") if x["kind"] == "train"]
    skipped = np.cumsum([line["skipped"] for line in lines])
    assert 0 < skipped[-2] < skipped[-1] == result.skipped == 12 - used
    rate = state.learning_rate(jobs.SETTINGS)
    wanted = [float(rate(line["step"] - s - 1)) for line, s in zip(lines, skipped, strict=True)]
    assert [line["learning_rate"] for line in lines] == pytest.approx(wanted)
    assert wanted[-1] == float(rate(used - 1)) > float(rate(11))


def test_data_on_the_host_gives_the_same_run_and_goes_on_where_it_was_stopped(
    whole, quick, tmp_path
):
    once = jobs.train(tmp_path / "once", host=True)
    for x, y in zip(leaves(once.state), leaves(whole[1].state), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-4, atol=1e-6)
    ours, theirs = (log.read(path / "metrics.jsonl") for path in (tmp_path / "once", whole[0]))
    for a, b in zip(ours, theirs, strict=True):
        assert a.pop("kind") == b.pop("kind") and a == pytest.approx(b, rel=1e-5)
    asked = iter(range(100))
    with pytest.raises(KeyboardInterrupt):
        jobs.train(tmp_path / "twice", host=True, should_stop=lambda: next(asked) == 2)
    assert 0 < checkpoint.steps(tmp_path / "twice/checkpoints")[-1] < 12
    again = jobs.train(tmp_path / "twice", host=True)
    assert_same_bytes(again.state, once.state)
    logs = [(tmp_path / name / "metrics.jsonl").read_bytes() for name in ("once", "twice")]
    assert logs[0] == logs[1]


def test_interrupted_and_resumed_is_the_same_run(whole, quick, tmp_path):
    directory, result = whole
    asked = iter(range(100))
    with pytest.raises(KeyboardInterrupt, match=r"stopped after step .*same command resumes"):
        jobs.train(tmp_path, should_stop=lambda: next(asked) == 2)
    stopped = checkpoint.steps(tmp_path / "checkpoints")[-1]
    assert 0 < stopped < 12 and stopped % 4  # not where it would have saved anyway
    again = jobs.train(tmp_path)
    assert_same_bytes(again.state, result.state)
    assert again.holdout == result.holdout
    written = (tmp_path / "metrics.jsonl").read_bytes()
    assert written == (directory / "metrics.jsonl").read_bytes()


def test_only_the_state_is_held_while_steps_are_taken(whole, quick, tmp_path):
    """A matrix, its two moments and its average; not their initial values, too."""
    largest = max(leaves(whole[1].state.params), key=np.size).shape

    def held():
        gc.collect()
        return sum(x.shape == largest for x in jax.live_arrays())

    before, found = held(), []
    with pytest.raises(KeyboardInterrupt):
        jobs.train(tmp_path, should_stop=lambda: bool(found.append(held()) or len(found) == 2))
    of_one = sum(np.shape(x) == largest for x in leaves(whole[1].state.params))
    assert [count - before for count in found] == [4 * of_one, 4 * of_one]


def test_a_stop_right_after_a_checkpoint_does_not_write_it_again(quick, monkeypatch, tmp_path):
    written, save = [], checkpoint.save
    monkeypatch.setattr(checkpoint, "save", lambda *a, **k: written.append(a[1]) or save(*a, **k))
    with pytest.raises(KeyboardInterrupt, match="stopped after step 4 of 12"):
        jobs.train(tmp_path, should_stop=lambda: bool(written))
    assert written == [4]


def test_a_finished_run_is_only_loaded(whole, quick, monkeypatch):
    directory, result = whole
    monkeypatch.setattr(step, "_program", lambda *_: precompile.Program(pytest.fail))
    before = (directory / "metrics.jsonl").read_bytes()
    again = jobs.train(directory)
    assert_same_bytes(again.state, result.state)
    assert again.holdout == result.holdout and again.samples_per_second == 0.0
    assert (directory / "metrics.jsonl").read_bytes() == before


@pytest.mark.parametrize(
    ("changed", "argument"),
    [
        ({"seed": 5}, "seed"),
        ({"demos": 7}, "the demonstrations"),
        ({"settings": dataclasses.replace(jobs.SETTINGS, steps=6)}, "train.steps"),
    ],
)
def test_another_training_is_not_taken_for_this_one(whole, quick, changed, argument):
    with mistakes.of(argument) as caught:
        jobs.train(whole[0], **changed)
    assert str(whole[0]) in caught.value.expected


def test_another_processors_last_bits_are_no_other_demonstrations(whole, quick, monkeypatch):
    fit = loop.normalizer.fit

    def rounded(*given):
        return jax.tree.map(lambda x: np.nextafter(x, np.inf, dtype=x.dtype), fit(*given))

    monkeypatch.setattr(loop.normalizer, "fit", rounded)
    assert_same_bytes(jobs.train(whole[0]).state, whole[1].state)


def test_damaged_checkpoint_costs_only_its_steps(whole, quick, tmp_path):
    directory, result = whole
    shutil.copytree(directory, tmp_path, dirs_exist_ok=True)
    newest = checkpoint.path_of(tmp_path / "checkpoints", 12)
    victim = max((f for f in newest.rglob("*") if f.is_file()), key=lambda f: f.stat().st_size)
    victim.write_bytes(victim.read_bytes()[:-7])
    with pytest.warns(UserWarning, match="step 12 is damaged"):
        again = jobs.train(tmp_path)
    assert_same_bytes(again.state, result.state)


@pytest.mark.release
def test_images_train_too_and_packed_parameters_give_the_same_run_and_resume(tmp_path, monkeypatch):
    settings = dataclasses.replace(jobs.SETTINGS, steps=2, holdout_demos=0)
    seen = {"observation": "image", "dtype": "bfloat16"}
    whole = jobs.train(tmp_path / "a", settings, **seen)
    monkeypatch.setattr(packed_params, "PLATFORMS", {"cpu"})  # and kernels turned
    asked = itertools.count(1)
    with pytest.raises(KeyboardInterrupt):
        jobs.train(tmp_path / "b", settings, **seen, should_stop=lambda: next(asked) == 2)
    assert checkpoint.steps(tmp_path / "b/checkpoints") == [1]
    packed = jobs.train(tmp_path / "b", settings, **seen)
    for x, y in zip(leaves(packed.state), leaves(whole.state), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_training_learns(tmp_path):
    settings = dataclasses.replace(
        jobs.SETTINGS, steps=300, log_every=50, checkpoint_every=300, steps_per_call=50
    )
    result = jobs.train(tmp_path, settings)
    lines = [x for x in log.read(tmp_path / "metrics.jsonl") if x["kind"] == "train"]
    assert lines[-1]["loss"] < 0.6 * lines[0]["loss"] and lines[-1]["roll_loss"] > 0
    assert result.samples_per_second > 0


def test_killed_again_and_again_ends_the_same(tmp_path):
    found = kill.survive(jobs.__file__, "train_and_export", tmp_path, kills=5)
    assert found.kills == 5
    for name in ("policy.safetensors", "metrics.jsonl"):
        assert found.killed[name] == found.whole[name]
    last = {name.split("/")[1] for name in found.killed if name.startswith("checkpoints/step")}
    assert last == {"step_00000008", "step_00000012"}


# Adam turns the rounding of a gradient near zero into a whole step of the learning rate: wide for
# bfloat16, whose parameters are compared on average.
@pytest.mark.parametrize(
    ("count", "observation", "dtype", "tolerance"),
    [
        (4, "state", "float32", 1e-4),
        pytest.param(2, "image", "bfloat16", 5e-2, marks=pytest.mark.release),
    ],
)
def test_many_devices_give_the_numbers_of_one(tmp_path, count, observation, dtype, tolerance):
    settings = dataclasses.replace(jobs.SETTINGS, holdout_demos=0)
    seen: dict[str, Any] = {"observation": observation, "dtype": dtype}
    last = jobs.train(tmp_path / "1", settings, **seen).state
    shutil.copytree(tmp_path / "1", tmp_path / "n")  # begun on one device, and resumed on many
    shutil.rmtree(checkpoint.path_of(tmp_path / "n/checkpoints", settings.steps))
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={count}"
    environment = {
        **os.environ,
        "XLA_FLAGS": flags,
        "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
    }
    subprocess.run(
        [sys.executable, jobs.__file__, str(count), str(tmp_path / "n"), observation, dtype],
        env=environment,
        check=True,
    )
    one, many = (list(log.read(tmp_path / name / "metrics.jsonl")) for name in "1n")
    for a, b in zip(one, many, strict=True):
        assert a.pop("kind") == b.pop("kind")
        assert a == pytest.approx(b, rel=tolerance)
    with np.load(tmp_path / "n/found.npz", allow_pickle=False) as found:
        drawn = jax.random.randint(state.step_keys(last.key, 5).batch, (16,), 0, 100)
        np.testing.assert_array_equal(found["frames"], drawn)
        for i, x in enumerate(leaves(last.params)):
            assert np.abs(found[str(i)] - x).mean() < tolerance * settings.learning_rate * 12


def test_learning_rate_and_average():
    settings = dataclasses.replace(jobs.SETTINGS, steps=1000, warmup_steps=100)
    rate = state.learning_rate(settings)
    assert float(rate(0)) == 0.0
    np.testing.assert_allclose(float(rate(100)), settings.learning_rate, rtol=1e-6)
    np.testing.assert_allclose(float(rate(550)), settings.learning_rate / 2, rtol=1e-3)
    np.testing.assert_allclose(float(rate(1000)), 0.0, atol=1e-9)
    assert float(state.ema_decay(jnp.int32(0), 0.999)) == 0.0
    np.testing.assert_allclose(float(state.ema_decay(jnp.int32(15), 0.999)), 1 - 16**-0.75)
    assert float(state.ema_decay(jnp.int32(10**6), 0.999)) == np.float32(0.999)


def test_a_half_written_line_is_dropped_and_the_rest_goes_on(tmp_path):
    path = tmp_path / "log"
    path.write_bytes(b'{"step": 3, "kind": "train"}\n{"step": 4, "kind": "holdout"}')
    log.resume(path, 4)
    log.append(path, 4, "holdout", {})
    assert [line["step"] for line in log.read(path)] == [3, 4]


def test_throughput_is_without_the_call_that_compiles():
    rate = loop._Pace(batch_size=16)
    assert rate.next_call(1, 100.0, 50) == 1
    assert rate.next_call(1, 0.5, 50) == 2 and rate.next_call(10, 0.5, 50) == 20
    assert rate.next_call(20, 0.1, 50) == 50
    assert rate.samples_per_second == pytest.approx(16 * 31 / 1.1)


def test_a_millimetre_is_another_dataset_and_a_last_bit_is_not():
    assert start._alike(np.float32([0.05, 3.0]), np.float32([0.05 + 1e-8, 3.0 + 5e-7]))
    assert not start._alike(np.float32([0.05, 3.0]), np.float32([0.051, 3.0]))
