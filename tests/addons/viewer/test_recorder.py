"""Demonstrations by an operator are an ordinary dataset, complete after each episode."""

import numpy as np
import pytest

from starjax import rcm
from starjax.addons.viewer import browse, recorder
from starjax.data import load, store
from starjax.runtime import files

SEED = 4


def demonstrated(steered, kept, trocar, limit=200):
    """Goes straight to the mark; one episode, not saved yet."""
    trial = kept.next_trial(trocar)
    state, frame, action, opening = steered.start(SEED, trocar, trial)
    goal = np.asarray(state.env.layout.p[0])
    while not frame.done and kept.length < limit:
        way = goal - action[0, 1:]
        action = action.copy()
        action[0, 1:] += way * min(1.0, 0.003 / max(np.linalg.norm(way), 1e-9))
        state, moment = steered.step(state, action, opening)
        frame = moment.frame
        kept.add(moment)
    return trial, frame


@pytest.fixture(scope="module")
def root(steered, tmp_path_factory):
    """Two successes through one trocar, a failure, and one through another trocar."""
    root = tmp_path_factory.mktemp("teleop") / "demos"
    with recorder.record_into(root, steered.env, SEED) as kept:
        for trocar, limit in ((2, 200), (2, 200), (2, 5), (9, 200)):
            trial, frame = demonstrated(steered, kept, trocar, limit)
            assert bool(frame.success) == (limit > 5)
            kept.save(trocar, trial)
    return root


@pytest.mark.slow
def test_episodes_load_as_demonstrations(root, steered):
    found = load.load(root, residency="host", report=lambda line: None)
    data = found.dataset
    assert len(data.length) == 3 and found.description["expert"] == "operator"
    assert store.keys(root) == [f"0002-000{i}-{SEED}" for i in range(3)] + [f"0009-0000-{SEED}"]
    p = rcm.trocar_position(data.trocar.trocar, steered.env.p_world_ref)
    per_frame = np.repeat(np.asarray(p), np.asarray(data.length), axis=0)
    assert np.max(rcm.rcm_error(data.command.pose, per_frame)) < 1e-6
    last = np.cumsum(data.length) - 1
    off = np.linalg.norm(data.observation.pose.p[last, 0] - data.observation.state[last], axis=-1)
    assert (off < 0.002).all()


@pytest.mark.slow
def test_more_can_be_added_and_numbers_go_on(root, steered):
    with recorder.record_into(root, steered.env, SEED) as kept:
        assert (kept.kept, kept.next_trial(2), kept.next_trial(9), kept.next_trial(0)) == (
            3,
            3,
            1,
            0,
        )
        kept.add(None)
        kept.discard()
        assert kept.length == 0


@pytest.mark.slow
def test_a_folder_is_one_process_at_a_time_and_one_dataset(root, steered):
    with (
        recorder.record_into(root, steered.env, SEED),
        pytest.raises(files.StorageError),
        recorder.record_into(root, steered.env, SEED),
    ):
        pass
    with pytest.raises(files.StorageError), recorder.record_into(root, steered.env, SEED + 1):
        pass


def test_a_full_disk_loses_no_episode(steered, tmp_path, monkeypatch):
    with recorder.record_into(tmp_path / "demos", steered.env, SEED) as kept:
        trial, _ = demonstrated(steered, kept, 0, limit=3)

        def full(*given):
            raise files.StorageError("the disk is full")

        with monkeypatch.context() as patch:
            patch.setattr(files, "commit_directory", full)
            with pytest.raises(files.StorageError):
                kept.save(0, trial)
        assert kept.length == 3
        assert kept.save(0, trial).is_dir() and kept.length == 0


@pytest.mark.slow
@pytest.mark.release
def test_recorded_episodes_are_shown_as_they_were(root):
    dataset = browse.open_dataset(root)
    shown = browse.read(dataset, dataset.keys[0])
    assert shown.outcome == "success" and shown.images is not None and len(dataset.keys) == 4
    folder = root / "episodes" / dataset.keys[0]
    np.testing.assert_array_equal([f.qpos for f in shown.frames], np.load(folder / "qpos.npy"))
    assert shown.frames[-1].success and not shown.frames[0].success
    trocar = store.verify(root, dataset.keys[0])
    expected = rcm.trocar_position(
        rcm.Trocar(*(np.float32(trocar[n]) for n in rcm.Trocar._fields)), [[0.0, 0.0, 0.15]]
    )
    np.testing.assert_allclose(shown.frames[0].p_world_trocar, expected, atol=1e-7)


@pytest.mark.slow
def test_a_damaged_episode_is_named(root, tmp_path):
    import shutil

    copy = tmp_path / "copy"
    shutil.copytree(root, copy)
    dataset = browse.open_dataset(copy)
    (copy / "episodes" / dataset.keys[1] / "qpos.npy").write_bytes(b"")
    with pytest.raises(store.DamagedEpisode, match=dataset.keys[1]):
        browse.read(dataset, dataset.keys[1])
