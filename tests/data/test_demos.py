"""Demonstrations: collection, kills, damage, and loading."""

# pyright: reportIndexIssue=false, reportOptionalSubscript=false, reportArgumentType=false
# pyright: reportGeneralTypeIssues=false, reportOptionalMemberAccess=false

import errno
import os
import resource
import shutil
import types
from pathlib import Path
from typing import Any

import jax
import kill
import mujoco
import numpy as np
import pytest
import stubs

from starjax import rcm
from starjax.core import errors, sources
from starjax.core.types import Agent
from starjax.data import demos, load, schema, store
from starjax.runtime import files, xla
from starjax.sim import env as sim_env
from starjax.sim.rollouts import agent, engine, episodes, fetching, programs, success_quota, workers
from starjax.sim.rollouts.placement import DeviceLayout

TROCARS = stubs.trocars(0, 8)
SETTINGS = schema.DemoSettings(per_trocar=4, seed=0, max_steps=100)
EXPERT = agent.from_single(stubs.EXPERT)


def collect(root, observation="state", chunk=5, trocars=TROCARS, report=print, env=None, **changed):
    env = env or stubs.make_env(observation, unlucky=0.4)
    settings = SETTINGS._replace(**changed)
    return demos.collect(
        root, env, EXPERT, trocars, settings, layout=DeviceLayout(lanes=chunk), report=report
    )


def job(root):
    """What the kill test runs."""
    collect(root)


@pytest.fixture(scope="module")
def sealed(tmp_path_factory):
    root = tmp_path_factory.mktemp("demos") / "d"
    return root, collect(root)


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    root = tmp_path_factory.mktemp("images") / "d"
    collect(root, "image", per_trocar=2)
    return root


@pytest.fixture
def copy(sealed, tmp_path):
    return shutil.copytree(sealed[0], tmp_path / "d")


def test_the_first_successes_of_every_trocar_are_kept(sealed):
    root, summary = sealed
    records = store.verify_all(root, store.keys(root)).values()
    assert summary["episodes"] == 8 < summary["trials"]  # some failed: the law below is not empty
    for trocar in range(2):
        here = [r for r in records if r["trocar"] == trocar]
        assert [r["trial"] for r in here] == list(range(len(here)))
        assert sum(r["success"] for r in here) == 4 and here[-1]["success"]
        assert all(bool(r["files"]) == r["success"] for r in here)


def test_programs_are_prepared_without_parsing_source(monkeypatch):
    # It runs in a thread: Python 3.11.7 fails if two threads parse (python/cpython#106905).
    monkeypatch.setattr(sources, "record", lambda _: pytest.fail("source parsed"))
    demos.precompile(stubs.make_env("state", unlucky=0.4), EXPERT, TROCARS, SETTINGS)


def test_an_episode_is_what_the_expert_did(sealed):
    root, _ = sealed
    demo = load.load(root, residency="host", report=lambda _: None).dataset
    first, last = int(demo.start[1]), int(demo.start[1] + demo.length[1] - 1)
    p, command = np.asarray(demo.observation.pose.p)[:, 0], np.asarray(demo.command.pose.p)[:, 0]
    np.testing.assert_allclose(p[first + 1 : last + 1], command[first:last], atol=1e-5)
    goal = np.asarray(demo.observation.state)[first, :3]
    assert np.linalg.norm(command[last] - goal) < 0.004 < np.linalg.norm(p[last] - goal)
    np.testing.assert_allclose(demo.trocar.trocar.radius, np.repeat(TROCARS.radius, 4, axis=0))
    assert int(demo.length.sum()) == len(p) == len(demo.episode)


def short_segments(monkeypatch, frames):
    shorter = episodes.DEMONSTRATION._replace(frames=frames)
    monkeypatch.setattr(episodes, "DEMONSTRATION", shorter)


def test_kills_leave_no_trace(tmp_path):
    survived = kill.survive(__file__, "job", tmp_path, kills=6)
    assert survived.kills == 6
    assert survived.killed == survived.whole
    assert len(survived.whole) > 50


@pytest.mark.parametrize(("chunk", "segment"), [(4, 16), (8, 3), (16, 5)])
def test_chunk_and_segment_do_not_matter(sealed, tmp_path, monkeypatch, chunk, segment):
    short_segments(monkeypatch, segment)
    collect(tmp_path / "other", chunk=chunk)
    assert kill.tree(tmp_path / "other") == kill.tree(sealed[0])


def test_images_do_not_depend_on_the_segment(images, tmp_path, monkeypatch):
    short_segments(monkeypatch, 3)
    collect(tmp_path / "other", "image", chunk=8, per_trocar=2)
    assert kill.tree(tmp_path / "other") == kill.tree(images)


def test_images_are_those_of_their_own_episode(images):
    observation = load.load(images, residency="host", report=lambda _: None).dataset.observation
    drawn = np.asarray(observation.images[stubs.CAMERA])[:, :3, 0, 0]
    p = np.asarray(observation.pose.p)[:, 0]
    np.testing.assert_allclose(drawn, p * 1000 + 128, atol=1.01)


def test_an_episode_ends_at_the_last_step(tmp_path, monkeypatch):
    short_segments(monkeypatch, 4)
    root = tmp_path / "d"
    collect(root, per_trocar=2, max_steps=14, keep_failures=True)
    records = [store.verify(root, key) for key in store.keys(root)]
    late = [r for r in records if not (r["success"] or r["invalid"])]
    assert late and all(r["length"] == 14 for r in late)
    assert all(r["files"]["p.npy"]["shape"] == [r["length"], 1, 3] for r in records)


def test_free_lanes_take_the_place_of_failures(tmp_path, monkeypatch):
    groups = []
    make = engine.make

    def counted(*args):
        run = make(*args)
        return lambda params, group: groups.append(group) or run(params, group)

    monkeypatch.setattr(engine, "make", counted)
    summary = collect(tmp_path / "d", chunk=16)
    assert [len(group) for group in groups] == [16]
    assert summary["episodes"] == 8 < summary["trials"] < 16


@pytest.mark.parametrize(("chunks", "lanes", "at_once"), [(9.5, 8, 4), (2.5, 8, 2), (0.5, 4, 1)])
def test_images_of_all_that_is_simulated_fit_the_memory(
    tmp_path, monkeypatch, chunks, lanes, at_once
):
    frame = programs.frame(stubs.make_env("image", unlucky=0.4), episodes.DEMONSTRATION)
    lane = 2 * demos.FRAME_GUESS * sum(np.dtype(x.dtype).itemsize * x.size for x in frame.values())
    memory = int(chunks * workers.CPU_LANES * lane / demos.MEMORY_SHARE)
    monkeypatch.setattr(xla, "memory_bytes", lambda: memory)
    monkeypatch.setattr(workers, "worker_count", lambda: 4)
    asked = []
    monkeypatch.setattr(success_quota, "run", lambda *args: asked.append(args[4:6]) or [])
    collect(tmp_path / "d", "image", chunk=0)
    assert asked == [(lanes, at_once)]


def _full_disk(monkeypatch):
    commit, calls = store.commit, []

    def failing(*args):
        calls.append(args)
        if len(calls) > 2:
            raise files.StorageError("no space left")
        return commit(*args)

    monkeypatch.setattr(store, "commit", failing)


def _interrupt(monkeypatch):
    fetch, calls = fetching.fetch, []

    def interrupted(slices):
        calls.append(slices)
        if len(calls) > 4:
            raise KeyboardInterrupt
        return fetch(slices)

    monkeypatch.setattr(fetching, "fetch", interrupted)


@pytest.mark.parametrize(
    ("stop", "error"), [(_full_disk, files.StorageError), (_interrupt, KeyboardInterrupt)]
)
def test_stopped_in_the_middle_the_same_command_completes_it(
    images, tmp_path, monkeypatch, stop, error
):
    root = tmp_path / "d"
    short_segments(monkeypatch, 4)
    with monkeypatch.context() as patch, pytest.raises(error):
        stop(patch)
        collect(root, "image", per_trocar=2)
    assert 0 < len(store.keys(root)) < len(store.keys(images))
    collect(root, "image", per_trocar=2)
    assert kill.tree(root) == kill.tree(images)


def test_failures_are_kept_on_request(tmp_path, sealed):
    summary = collect(tmp_path / "d", keep_failures=True)
    assert summary["trials"] == sealed[1]["trials"] and summary["frames"] > sealed[1]["frames"]
    records = store.verify_all(tmp_path / "d", store.keys(tmp_path / "d")).values()
    assert all(record["files"] for record in records)
    kept = load.load(tmp_path / "d", report=lambda _: None)
    assert len(kept.dataset.length) == 8


def _flip(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(data)


DAMAGE = {
    "flipped": _flip,
    "truncated": lambda path: path.write_bytes(path.read_bytes()[:-7]),
    "emptied": lambda path: path.write_bytes(b""),
    "removed": lambda path: path.unlink(),
}


@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize("name", ["command_p.npy", "episode.json"])
def test_damage_is_named_and_repaired(copy, sealed, damage, name):
    key = next(k for k in store.keys(copy) if store.verify(copy, k)["success"])
    path = copy / "episodes" / key / name
    DAMAGE[damage](path)
    with pytest.raises(store.DamagedEpisode, match=f"{key}/{name}"):
        load.load(copy, report=lambda _: None)
    said = []
    collect(copy, report=said.append)
    assert key in said[0] and "damaged" in said[0]
    assert kill.tree(copy) == kill.tree(sealed[0])


@pytest.mark.parametrize("name", ["SEALED.json", "dataset.json"])
def test_damaged_lists_are_noticed(copy, name):
    _flip(copy / name)
    with pytest.raises(ValueError, match=name):
        load.load(copy, report=lambda _: None)


@pytest.mark.parametrize("damage", ["truncated", "removed"])
def test_a_damaged_description_is_written_again(copy, sealed, damage):
    DAMAGE[damage](copy / "dataset.json")
    with pytest.raises(ValueError, match=r"dataset\.json"):
        store.read_seal(copy)
    (copy / "SEALED.json").unlink()
    collect(copy)
    assert kill.tree(copy) == kill.tree(sealed[0])


def test_a_disk_that_fails_deletes_no_episode(copy, monkeypatch):
    def fail(path):
        raise OSError(errno.EIO, os.strerror(errno.EIO), str(path))

    before = kill.tree(copy)
    with monkeypatch.context() as patch:
        patch.setattr(store.files, "sha256", fail)
        with pytest.raises(files.StorageError, match=r"cannot read .*\.npy: Input/output error"):
            collect(copy)
    assert kill.tree(copy) == before


def test_episodes_of_another_seed_are_not_taken_for_these(copy):
    (copy / "dataset.json").unlink()
    (copy / "SEALED.json").unlink()
    with pytest.raises(files.StorageError, match=rf"is of seed {SETTINGS.seed}, not 77"):
        collect(copy, seed=77)


def test_what_only_the_dataset_that_is_there_has_counts(tmp_path):
    collect(tmp_path, expert="one_wall")
    with pytest.raises(files.StorageError, match="its expert is one_wall, not default"):
        collect(tmp_path)


def test_an_incomplete_dataset_is_not_loaded(copy):
    (copy / "SEALED.json").unlink()
    with pytest.raises(ValueError, match="not complete"):
        load.load(copy)
    with pytest.raises(ValueError, match="expected a folder of demonstrations"):
        load.load(copy / "nothing")


def test_another_dataset_is_not_mixed_in(copy):
    with pytest.raises(files.StorageError, match="its max_steps is 100, not 7"):
        collect(copy, max_steps=7)


@pytest.mark.parametrize("bad", [{"per_trocar": 0}, {"max_steps": 0}, {"chunk": -1}])
def test_bad_arguments_are_named(tmp_path, bad):
    with pytest.raises(errors.UsageError) as raised:
        collect(tmp_path / "d", **bad)
    assert next(iter(bad)).replace("chunk", "lanes") in raised.value.argument


def test_files_that_a_desktop_leaves_among_the_episodes_are_left_alone(copy, sealed):
    (copy / "episodes" / ".DS_Store").write_bytes(b"x")
    assert ".DS_Store" not in store.keys(copy)
    assert collect(copy) == sealed[1]


@pytest.mark.parametrize("name", ["@eaDir", ".snapshot", "lost+found", "0000-0000-0 (copy)"])
def test_folders_that_are_no_episodes_are_left_alone(copy, sealed, name):
    damaged = store.keys(copy)[0]
    (copy / "episodes" / damaged / "episode.json").unlink()
    kept = copy / "episodes" / name / "kept"
    kept.parent.mkdir()
    kept.write_bytes(b"x")
    said = []
    assert collect(copy, report=said.append) == sealed[1]
    assert len(said) == 1 and f"{damaged}/episode.json" in said[0] and "damaged" in said[0]
    assert kept.read_bytes() == b"x"


def test_every_key_is_found_again(tmp_path):
    names = [store.key(*numbers) for numbers in ((0, 0, 0), (11, 12345, 2**32 - 1), (10000, 7, 3))]
    for name in names:
        store.commit(tmp_path, name, {}, {})
    assert store.keys(tmp_path) == sorted(names)


def test_a_hopeless_expert_is_an_error(tmp_path):
    env = stubs.make_env(unlucky=1.0)
    with pytest.raises(success_quota.ExpertFailed, match="above 50%"):
        collect(tmp_path, env=env, chunk=8, max_steps=9)


def test_no_space_is_said_before_anything_runs(tmp_path, monkeypatch):
    usage = files.shutil.disk_usage(tmp_path)._replace(free=1000)
    monkeypatch.setattr(files.shutil, "disk_usage", lambda _: usage)
    monkeypatch.setattr(engine, "make", lambda *_: pytest.fail("it was about to compile"))
    with pytest.raises(files.StorageError, match=r"will be written, the disk has 1 kB free"):
        collect(tmp_path / "d")


def test_a_read_only_folder_is_said_before_anything_runs(tmp_path, monkeypatch):
    def refuse(path, data):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))

    # Not by the folder's mode, which does not bind the superuser.
    monkeypatch.setattr(files.Path, "write_bytes", refuse)
    monkeypatch.setattr(engine, "make", lambda *_: pytest.fail("it was about to compile"))
    with pytest.raises(files.StorageError, match="cannot write"):
        collect(tmp_path / "d")


@pytest.mark.parametrize("residency", ["device", "host", "disk"])
def test_all_residencies_hold_the_same(images, residency):
    said = []
    loaded = load.load(images, residency=residency, report=said.append)
    reference = load.load(images, report=said.append)
    assert reference.residency == "device" and "resident on the device" in said[1]
    assert f"{files.size(loaded.bytes)}" in said[0]
    image = loaded.dataset.observation.images[stubs.CAMERA]
    assert isinstance(image, jax.Array) == (residency == "device")
    assert isinstance(image, load.EpisodeArray) == (residency == "disk")
    order = np.array([7, 0, 3, 3, image.shape[0] - 1])
    whole = reference.dataset.observation.images[stubs.CAMERA]
    np.testing.assert_array_equal(image[order], whole[order])
    assert image[order].dtype == np.uint8 and image.shape[1:] == (6, 6, 3)
    for ours, theirs in zip(
        jax.tree.leaves(loaded.dataset.command), jax.tree.leaves(reference.dataset.command)
    ):
        np.testing.assert_array_equal(ours, theirs)


def test_images_may_stay_on_disk_and_are_found_there(images):
    said = []
    whole = load.load(images, report=said.append)
    without = load.load(images, images=False, report=said.append)
    assert without.dataset.observation.images is None and without.bytes < whole.bytes
    assert "without images" in said[1]
    observation = whole.dataset.observation._replace(images=None)
    jax.tree.map(np.testing.assert_array_equal, without.dataset.observation, observation)
    frames, drawn = load.frames(images)[stubs.CAMERA], whole.dataset.observation.images
    some = np.array([0, 7, frames.shape[0] - 1])
    np.testing.assert_array_equal(frames[some], np.asarray(drawn[stubs.CAMERA])[some])
    for frame in range(frames.shape[0]):  # in turn, to bound the memory
        frames[frame]
        assert not _mapped(images)


def _mapped(folder: Path) -> int:
    """How many of the folder's files this process has mapped into its memory."""
    lines = Path("/proc/self/maps").read_text().splitlines()
    return len({line.split()[-1] for line in lines if str(folder) in line})


def test_more_episodes_than_a_process_may_open_files(tmp_path):
    count = 400
    paths = [tmp_path / f"{i}.npy" for i in range(count)]
    for i, path in enumerate(paths):
        np.save(path, np.full((2, 3), i))
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    opened = len(os.listdir("/proc/self/fd"))
    resource.setrlimit(resource.RLIMIT_NOFILE, (opened + count - 50, limits[1]))
    try:
        frames = load.EpisodeArray(paths, 2 * np.arange(count), np.full(count, 2))
        whole, some = frames.read(), frames[np.arange(0, 2 * count, 2)]
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)
    np.testing.assert_array_equal(whole[::2, 0], np.arange(count))
    np.testing.assert_array_equal(some, whole[::2])


def test_demonstrations_without_images_have_no_frames(sealed):
    with pytest.raises(errors.UsageError) as raised:
        load.frames(sealed[0])
    assert raised.value.argument == "root"


def test_place_depends_on_what_is_free(monkeypatch):
    monkeypatch.setattr(load.xla, "available_bytes", lambda: 1000)
    # on a CPU there are two copies for a moment, in the same memory
    assert [load.place_for(n) for n in (299, 599, 700)] == ["device", "host", "disk"]
    # and each of several devices has one
    monkeypatch.setattr(load.jax, "local_device_count", lambda: 2)
    assert [load.place_for(n) for n in (149, 151)] == ["device", "host"]


def test_what_does_not_fit_the_host_does_not_pass_through_it(monkeypatch):
    stats = {"bytes_limit": 10_000, "bytes_in_use": 0}
    gpu = types.SimpleNamespace(platform="gpu", memory_stats=lambda: stats)
    monkeypatch.setattr(load.jax, "local_devices", lambda: [gpu])
    monkeypatch.setattr(load.xla, "available_bytes", lambda: 1000)
    assert [load.place_for(n) for n in (599, 601)] == ["device", "disk"]


def test_nothing_is_unpickled(images, tmp_path):
    root = shutil.copytree(images, tmp_path / "d")
    key = next(k for k in store.keys(root) if store.verify(root, k)["success"])
    np.save(root / "episodes" / key / "p.npy", np.array([{}]), allow_pickle=True)
    with pytest.raises(ValueError, match=r"pickle|Python objects"):
        load.load(root, verify=False, report=lambda _: None)


def test_an_episode_starts_and_steps_as_its_seed_says(sealed):
    """Follows the seed rule in dataset.json: never the states of an evaluation with this seed."""
    root, _ = sealed
    env = stubs.make_env("state", unlucky=0.4)
    stream = jax.random.fold_in(jax.random.key(0), schema.STREAM)
    for record in load._successful(root, store.read_seal(root), True):
        key = jax.random.fold_in(jax.random.fold_in(stream, record["trocar"]), record["trial"])
        key_env, key_expert = jax.random.split(key)
        trocar = rcm.Trocar(*(field[record["trocar"]] for field in TROCARS))
        state = env.reset(key_env, sim_env.EnvParams(trocar))
        command, _, _ = stubs.EXPERT.act(stubs.EXPERT.init(key_expert, state), state)
        wanted = {
            "qpos": state.physics.qpos,
            "state": env.observe(state).state,
            "command_p": command.pose.p,
            "rcm_error": env.step(state, command).rcm_error,
        }
        for name, value in wanted.items():
            found = np.load(root / "episodes" / record["key"] / f"{name}.npy")[0]
            np.testing.assert_allclose(found, value, atol=1e-6, err_msg=name)
        for name in rcm.Trocar._fields:
            np.testing.assert_array_equal(record[name], getattr(trocar, name))
        assert record["labels"] == {k: int(v) for k, v in env.labels(state).items()}


def test_the_label_of_a_disturbed_command_is_what_is_recorded(tmp_path):
    def act(key, state):
        command, key, label = stubs.EXPERT.act(key, state)
        moved = command._replace(pose=command.pose._replace(p=command.pose.p + 0.001))
        return moved, key, label._replace(gripper=-label.gripper)

    disturbed = agent.from_single(Agent(stubs.EXPERT.init, act))
    env, settings = stubs.make_env(unlucky=0.0), SETTINGS._replace(per_trocar=1)
    demos.collect(tmp_path, env, disturbed, TROCARS, settings, layout=DeviceLayout(lanes=2))
    dataset = load.load(tmp_path, residency="host", report=lambda _: None).dataset
    np.testing.assert_array_equal(dataset.command.gripper, -1.0)
    np.testing.assert_array_equal(dataset.observation.gripper, 1.0)


def test_every_field_is_loaded_as_itself(tmp_path):
    """With two arms and two cameras."""
    env = stubs.make_env("image", arms=2, cameras=("left", "right"))
    settings = SETTINGS._replace(per_trocar=1)
    description = schema.describe(env, stubs.trocars(0, 8, arms=2), settings)
    rng = np.random.default_rng(0)
    arrays = {
        name: [rng.integers(0, 200, (3, *feature["shape"])).astype(feature["dtype"])]
        for name, feature in description["features"].items()
    }
    place = {"radius": [0.01, 0.02], "polar": [1.0, 1.1], "azimuth": [2.0, 2.1]}
    store.create(tmp_path, description)
    outcome = {"success": True, "length": 3, **place}
    store.seal(tmp_path, {"k": store.commit(tmp_path, "k", outcome, arrays)})
    it = load.load(tmp_path, residency="host", report=lambda _: None).dataset
    seen, said = it.observation, it.command
    found = {
        "p": seen.pose.p,
        "R": seen.pose.R,
        "gripper": seen.gripper,
        "image_left": seen.images["left"],
        "image_right": seen.images["right"],
        "command_p": said.pose.p,
        "command_R": said.pose.R,
        "command_gripper": said.gripper,
    }
    assert seen.pose.p.shape == (3, 2, 3) and seen.state is None
    for name, leaf in found.items():
        np.testing.assert_array_equal(leaf, arrays[name][0], name)
    told = rcm.trocar_frame(
        rcm.Trocar(*np.float32(list(place.values()))),
        env.p_world_ref,
        np.array(stubs.ROLL_ZERO, np.float32),
    )
    jax.tree.map(lambda ours, x: np.testing.assert_array_equal(ours[0], x), it.trocar, told)


def test_two_arms_and_two_cameras_are_collected(tmp_path):
    env = stubs.make_env("image", unlucky=0.0, arms=2, cameras=("left", "right"))
    collect(tmp_path, trocars=stubs.trocars(0, 8, arms=2), env=env, per_trocar=1, max_steps=60)
    found = load.load(tmp_path, report=lambda _: None)
    seen = found.dataset.observation
    assert seen.pose.p.shape[1:] == (2, 3) and seen.images.keys() == {"left", "right"}
    np.testing.assert_array_equal(np.asarray(seen.images["left"]) + 1, seen.images["right"])
    assert found.description["scene"] == {
        "task": "reach",
        "arms": ["point", "point"],
        "tools": ["tip", "tip"],
        "cameras": ["left", "right"],
    }
    np.testing.assert_allclose(found.dataset.trocar.roll_zero[0], stubs.ROLL_ZERO, rtol=1e-6)


def test_software_versions_bind_an_unfinished_dataset_only(tmp_path):
    one, two = ({"schema": 2, "seed": 0, "versions": {"jax": v}} for v in "12")
    assert store.digest(one) == store.digest(two) != store.digest({**one, "seed": 1})
    store.create(tmp_path, one)
    with pytest.raises(
        files.StorageError, match="an incomplete dataset of other software: its versions is"
    ):
        store.create(tmp_path, two)
    store.seal(tmp_path, {})
    store.create(tmp_path, two)


def test_the_description_tells_scenes_trocars_and_experts_apart():
    def scene(x):
        xml = f'<mujoco><worldbody><geom size="{x}"/></worldbody></mujoco>'
        return types.SimpleNamespace(mj_model=mujoco.MjModel.from_xml_string(xml))

    def name(env, trocars=TROCARS, **changed):
        return store.digest(schema.describe(env, trocars, SETTINGS._replace(**changed)))

    env = stubs.make_env()._replace(scene=scene(0.1))
    same = {
        name(env),
        name(env._replace(scene=scene(0.1))),
        name(env, expert="default"),
    }
    others = [
        name(env, expert="one_wall"),
        name(env, keep_failures=True),
        name(env, trocars=stubs.trocars(0, 9)),
        name(env._replace(scene=scene(0.2))),
        name(env._replace(p_world_ref=np.float32([[0, 0, 0.1]]))),
        name(env._replace(names=env.names._replace(arms=("other",)))),
    ]
    assert len(same) == 1 and len({*same, *others}) == 7


def test_a_folder_under_another_name_is_damage(copy):
    first, second = store.keys(copy)[:2]
    store.remove(copy, second)
    shutil.copytree(copy / "episodes" / first, copy / "episodes" / second)
    with pytest.raises(store.DamagedEpisode, match=second):
        store.verify(copy, second)


def test_a_sound_episode_that_was_not_sealed_is_noticed(copy):
    key = store.keys(copy)[0]
    record = store.verify(copy, key)
    files_ = {name[:-4]: [np.load(copy / "episodes" / key / name)] for name in record["files"]}
    outcome = {k: v for k, v in record.items() if k not in ("key", "files", "digest")}
    store.remove(copy, key)
    store.commit(copy, key, {**outcome, "loose": not outcome["loose"]}, files_)
    store.verify(copy, key)
    with pytest.raises(store.DamagedEpisode, match=rf"{key}/episode.json: is not the episode"):
        load.load(copy, report=lambda _: None)


def test_several_gpus_share_what_one_would_do(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    devices: Any = [None] * 4
    lanes = [demos._fast(devices, total, 1) for total in (240, 257, 4000)]
    assert lanes == [demos.GPU_LANES, 2 * demos.GPU_LANES, 4 * demos.GPU_LANES]
    assert demos._fast(None, 4000, 1) == demos.GPU_LANES
    # as several processes do
    lanes = [demos._fast(None, total, 2) for total in (240, 4000)]
    assert lanes == [demos.GPU_LANES // 2, demos.GPU_LANES]
