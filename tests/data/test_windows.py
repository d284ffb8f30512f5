"""Windows: their frames, on the device and on the host."""

import fakes
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax import rcm
from starjax.core import methods
from starjax.core.methods import METHODS
from starjax.data import normalizer, windows

STRAIGHT = {name: row for name, row in METHODS.items() if not normalizer.has_wrist(row)}


@pytest.fixture(scope="module")
def dataset():
    return fakes.dataset(seed=0, demos=3, length=20)


def test_window_repeats_first_and_last_frame():
    frame = np.array([10, 11, 29])
    observed, commanded = windows.window_frames(frame, np.full(3, 10), np.full(3, 29), 3, 4)
    np.testing.assert_array_equal(observed, [[10, 10, 10], [10, 10, 11], [27, 28, 29]])
    np.testing.assert_array_equal(commanded, [[10, 11, 12, 13], [11, 12, 13, 14], [29, 29, 29, 29]])


def test_windows_stay_inside_their_demonstration(dataset):
    frames = jnp.arange(60, dtype=jnp.int32)
    # the position of every frame is made to say which frame it is
    numbered = dataset.observation._replace(gripper=frames.astype(jnp.float32)[:, None])
    batch = windows.gather(dataset.replace(observation=numbered), frames, 2, 8)
    owner = np.asarray(batch.observation.gripper)[..., 0].astype(int) // 20
    np.testing.assert_array_equal(owner, np.repeat(np.arange(60) // 20, 2).reshape(60, 2))
    radius = np.repeat(dataset.trocar.trocar.radius, 20, axis=0)
    np.testing.assert_array_equal(batch.trocar.trocar.radius, radius)


def test_host_and_device_gather_the_same(dataset):
    frames = np.array([[0, 19, 20], [33, 59, 41]], np.int32)
    on_device = windows.gather(dataset, jnp.asarray(frames), 2, 16)
    on_host = windows.gather(jax.tree.map(np.asarray, dataset), frames, 2, 16)
    assert isinstance(on_host.command.gripper, np.ndarray)
    assert on_device.command.pose.R.shape == (2, 3, 16, 1, 3, 3)
    jax.tree.map(np.testing.assert_array_equal, on_device, on_host)


def ports(numbers):
    """A trocar for each number, at one distance from the nominal one."""
    count = len(numbers)
    return fakes.told(rcm.Trocar(np.full(count, 0.02), np.full(count, 1.5), 0.1 * numbers))


def test_holdout_is_whole_demonstrations_spread_over_the_dataset():
    start, length = np.arange(16) * 10, np.full(16, 10)
    train, held = windows.split_holdout(start, length, ports(np.arange(16) // 2), 4)
    assert sorted(np.concatenate([train, held])) == list(range(160))
    np.testing.assert_array_equal(np.unique(held // 10), [2, 6, 10, 14])
    assert len(held) == 40


def test_holdout_never_takes_more_than_a_quarter():
    train, held = windows.split_holdout(np.arange(3) * 10, np.full(3, 10), ports(np.zeros(3)), 8)
    assert len(train) == 30 and len(held) == 0


def test_holdout_leaves_every_trocar_a_demonstration():
    start, length, port = np.arange(16) * 10, np.full(16, 10), np.arange(16) // 2
    port[2], port[6] = 20, 21  # alone at theirs
    train, held = windows.split_holdout(start, length, ports(port), 4)
    np.testing.assert_array_equal(np.unique(held // 10), [10, 14])
    assert set(port[train // 10]) == set(port)


def test_no_demonstrations_is_an_error():
    with pytest.raises(ValueError, match="dataset: expected at least one demonstration"):
        windows.split_holdout(np.zeros(0, int), np.zeros(0, int), ports(np.zeros(0)), 8)


def test_sampled_frames_are_training_frames():
    frames = jnp.array([3, 5, 8], jnp.int32)
    drawn = np.asarray(windows.sample_frames(jax.random.key(0), frames, 3000))
    values, counts = np.unique(drawn, return_counts=True)
    np.testing.assert_array_equal(values, [3, 5, 8])
    assert counts.min() > 850


@pytest.mark.parametrize("name", STRAIGHT)
def test_normalised_actions_fill_the_box(dataset, name):
    method = METHODS[name]
    stats = normalizer.fit(method, fakes.TASK, dataset, np.arange(60))
    told = jax.tree.map(lambda x: jnp.repeat(x, 20, axis=0), dataset.trocar)
    command = dataset.command
    raw = normalizer.encode(method.action_space, command.pose, command.gripper, told)
    scaled = np.asarray(stats.action.normalize(raw))
    space = rcm.ACTION_SPACES[method.action_space]
    for part, where in space.slices.items():
        if part == "R":
            np.testing.assert_allclose(scaled[:, where], raw[:, where], atol=1e-6)
        else:
            np.testing.assert_allclose(scaled[:, where].min(0), -1.0, atol=1e-5)
            np.testing.assert_allclose(scaled[:, where].max(0), 1.0, atol=1e-5)
    np.testing.assert_allclose(scaled[:, -1], raw[:, -1], atol=1e-6)
    np.testing.assert_allclose(stats.action.denormalize(scaled), raw, atol=1e-6)


def test_state_statistics_leave_the_rotation(dataset):
    stats = normalizer.fit(METHODS["stardiff"], fakes.TASK, dataset, np.arange(60))
    np.testing.assert_array_equal(stats.state.low[3:9], -1.0)
    np.testing.assert_array_equal(stats.state.high[3:9], 1.0)
    state = np.asarray(stats.state.normalize(dataset.observation.state))
    # the fake's target never leaves its height: a constant entry is centred, not blown up
    np.testing.assert_allclose(state[:, 11], 0.0, atol=1e-6)
    assert state.min() >= -1.0 - 1e-5 and state.max() <= 1.0 + 1e-5


def test_only_the_given_frames_are_fitted(dataset):
    few = normalizer.fit(METHODS["dp_ee"], fakes.TASK, dataset, np.arange(20))
    p = np.asarray(dataset.command.pose.p[:20, 0])
    np.testing.assert_allclose(few.action.low[:3], p.min(0), atol=1e-7)


def test_non_finite_demonstrations_are_refused(dataset):
    broken = dataset.command._replace(gripper=dataset.command.gripper.at[7].set(jnp.nan))
    with pytest.raises(ValueError, match="dataset: expected finite"):
        normalizer.fit(METHODS["dp_ee"], fakes.TASK, dataset.replace(command=broken), np.arange(60))


def test_methods_are_table_two():
    assert len(methods.TABLE_II) == 8 and set(STRAIGHT) - set(methods.TABLE_II) == {"stardiff_told"}
    assert all(isinstance(method, methods.Method) for method in METHODS.values())
    assert {name for name, method in STRAIGHT.items() if method.projects} == {"dp_ee_proj"}
    assert {name for name, method in STRAIGHT.items() if method.hierarchical} == {
        "stardiff",
        "stardiff_told",
    }
    borrowed = {n: m.weights_of for n, m in STRAIGHT.items() if m.weights_of != n}
    assert borrowed == {"dp_ee_proj": "dp_ee", "stardiff_single": "dp_rcm4"}


def test_the_hierarchy_that_is_told_the_trocar_is_no_other():
    told = methods.behaviour("stardiff_told")
    assert told.sees_trocar and told._replace(sees_trocar=False, weights_of="stardiff") == (
        methods.behaviour("stardiff")
    )


def test_only_the_given_frames_states_are_fitted(dataset):
    few = normalizer.fit(METHODS["dp_ee"], fakes.TASK, dataset, np.arange(40))
    state = np.asarray(dataset.observation.state)
    np.testing.assert_allclose(few.state.low[:2], state[:40, :2].min(0), atol=1e-7)
    np.testing.assert_allclose(few.state.high[:2], state[:40, :2].max(0), atol=1e-7)


def test_over_frames_is_of_every_chunk(dataset, monkeypatch):
    frames = np.arange(60)[::-1]
    monkeypatch.setattr(windows, "_CHUNK", 7)
    found = windows.over_frames(
        dataset, frames, lambda _, command, told: np.c_[command.pose.p[:, 0], told.trocar.radius]
    )
    radius = np.repeat(np.asarray(dataset.trocar.trocar.radius), 20)
    np.testing.assert_array_equal(found, np.c_[dataset.command.pose.p[:, 0], radius][frames])


def test_a_millimetre_is_a_range_and_less_than_a_tenth_is_not():
    box = normalizer._min_max(np.array([[0, 1], [1e-3, 1 + 9e-5]]), np.arange(2))
    np.testing.assert_allclose(box.high - box.low, [1e-3, 2.0], rtol=1e-4)
