"""The loops of view, dataset and teleoperation, without a browser."""

import functools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starjax import rcm
from starjax.addons.viewer import (
    browse,
    devices,
    recorder,
    relief,
    selection,
    shared_control,
    simulation,
    teleop,
    teleop_target,
    tip_handle,
    view,
)
from starjax.addons.viewer import page as pages
from starjax.data import load, store
from starjax.sim.rollouts import agent, trocars

pytestmark = pytest.mark.slow

SEED = 7


@pytest.fixture
def page():
    with pages.serve(pages.ANY) as server:
        yield server


def after(count, then=None):
    """`should_stop` that is true after so many looks; `then` (look) -> a call at that look."""
    looks = iter(range(count))

    def should_stop():
        look = next(looks, None)
        if look is not None and then and look in then:
            then[look]()
        return look is None

    return should_stop


def press(page, label):
    """Triggers a hotkey."""
    handles = page.gui._command_handle_from_uuid.values()
    (call,) = next(h for h in handles if h.label == label)._impl.trigger_cb
    call(None)


@pytest.fixture
def hurried(monkeypatch):
    """Time that does not wait."""
    quick = functools.partial(pages.Clock, sleep=lambda seconds: None)
    monkeypatch.setattr(pages, "Clock", quick)


def test_trials_follow_one_another(page, expert, hurried, monkeypatch):
    monkeypatch.setattr(simulation, "load", lambda who, arms=(): expert)
    asked = selection.ViewOptions((simulation.expert("reach"),), trocar=2, seed=SEED)
    said = view.run(page, asked, after(320, {300: lambda: press(page, "Next")}))
    won, ended = (int(word) for word in said.split(":")[1].split("trials")[0].split("of"))
    assert won == ended >= 2


def test_a_pause_holds_and_a_step_is_one(page, expert, hurried, monkeypatch):
    monkeypatch.setattr(simulation, "load", lambda who, arms=(): expert)
    taken = []
    step = expert.step
    counted = expert._replace(step=lambda *given: (taken.append(1), step(*given))[1])
    monkeypatch.setattr(simulation, "load", lambda who, arms=(): counted)
    asked = selection.ViewOptions((simulation.expert("reach"),), seed=SEED)
    presses = {0: lambda: press(page, "Play or pause"), 3: lambda: press(page, "Step")}
    view.run(page, asked, after(8, presses))
    assert len(taken) == 2  # the first one compiles, and is dropped


def test_the_page_says_that_it_compiles_and_that_it_pauses(page, expert, hurried, monkeypatch):
    shown, at_first_step = [], []
    monkeypatch.setattr(pages.Status, "set", lambda self, text: shown.append(text))
    step = expert.step

    def recorded(*given):
        at_first_step.append(shown[-1])
        return step(*given)

    monkeypatch.setattr(simulation, "load", lambda who, arms=(): expert._replace(step=recorded))
    asked = selection.ViewOptions((simulation.expert("reach"),), seed=SEED)
    view.run(page, asked, after(6, {2: lambda: press(page, "Play or pause")}))
    assert at_first_step[0].startswith("Compiling") and "Compiling" not in at_first_step[-1]
    assert ", paused:" in shown[-1]


def test_a_dragged_trocar_stays_for_the_next_trial_until_another_is_selected(page, expert):
    starts = []

    def start(seed, configuration, trial, trocar=None):
        starts.append(trocar)
        return expert.start(seed, configuration, trial, trocar)

    rollouts = view.Rollouts(page, [expert._replace(start=start)], pages.Status(page.gui))
    rollouts.begin(SEED, 8, 0)
    (handle,), p = rollouts.trocars._handles._handles, (0.01, 0.02, 0.152)
    handle.position = p  # as the page's message does
    rollouts.advance()
    rollouts.begin(SEED, 8, 1)
    np.testing.assert_allclose(rollouts._frames[0].p_world_trocar, [p], atol=1e-5)
    rollouts.trocars.release()
    rollouts.begin(SEED, 8, 1)
    assert starts[0] is None and starts[1] is not None and starts[2] is None
    rollouts.remove()


def widget(page, label):
    """The dropdown or button group of a label."""
    handles = page.gui._gui_input_handle_from_uuid.values()
    return next(h for h in handles if h.label == label and hasattr(h, "options"))


def test_an_own_trocar_is_shown_as_such_and_counted_apart(page, expert, hurried, monkeypatch):
    monkeypatch.setattr(simulation, "load", lambda who, arms=(): expert)
    made, shown = [], []
    original = view.TrocarControls
    monkeypatch.setattr(
        view, "TrocarControls", lambda *given: made.append(original(*given)) or made[0]
    )

    def drag():
        made[0]._handles._handles[0].position = (0.01, 0.02, 0.152)

    def look():
        shown.append((widget(page, "Trocar").value, made[0].is_own))

    def choose():
        widget(page, "Trocar").value = "3 (seen)"

    asked = selection.ViewOptions((simulation.expert("reach"),), trocar=2, seed=SEED)
    acts = {1: look, 160: drag, 163: look, 480: look, 490: choose, 495: look}
    said = view.run(page, asked, after(500, acts))
    assert [own for _, own in shown] == [False, True, True, False]
    names = [name for name, _ in shown]
    assert names[0] == "2 (seen)" and names[1] == names[2] and "own" in names[1]
    assert names[3] == "3 (seen)" and "own" not in str(widget(page, "Trocar").options)
    first, own = said.split(" trials succeeded, at your own trocars ")
    assert int(first.split()[-1]) >= 1 and int(own.split(";")[0].split()[-1]) >= 1


def test_the_button_says_what_it_does(page):
    player = pages.Player(page.gui, pages.UiRequests())
    handles = list(page.gui._gui_input_handle_from_uuid.values())
    group = next(h for h in handles[::-1] if "Step" in getattr(h, "options", ()))
    assert player.is_playing and group.options[0] == "Pause"
    press(page, "Play or pause")
    assert not player.is_playing and group.options == ("Play", "Step", "Again", "Next")


def directed(steered, trocar):
    """A device that goes straight to the mark and rests there."""
    state, _, action, _ = steered.start(SEED, trocar, 0)
    way = np.asarray(state.env.layout.p[0]) - action[0, 1:]
    count = int(np.ceil(np.linalg.norm(way) * 30 / (0.8 * teleop_target.SPEED)))
    axes = shared_control.camera_axes(steered.env)
    deflection = axes.T @ way * 30 / (count * teleop_target.SPEED)
    steps = iter([np.array([0.0, *deflection])] * count)
    still = np.zeros(4)
    return devices.Device(
        lambda: devices.Reading(next(steps, still), (False, False)), close=lambda: None
    )


@pytest.mark.release
def test_a_person_demonstrates_and_keeps_it(page, steered, hurried, tmp_path):
    trocar, root = 3, tmp_path / "demos"
    with recorder.record_into(root, steered.env, SEED) as kept:
        said = teleop.run(
            page,
            steered,
            kept,
            after(200, {190: lambda: press(page, "Save the episode")}),
            device=directed(steered, trocar),
            trocar=trocar,
            seed=SEED,
        )
    assert said.startswith("1 episodes saved, 1 of them successful")
    data = load.load(root, report=lambda line: None).dataset
    told = trocars.select(steered.env.task.trocars, np.array([trocar]))
    np.testing.assert_allclose(np.asarray(data.trocar.trocar), np.asarray(told), rtol=1e-6)

    dataset = browse.open_dataset(root, image_size=48)
    drawn = browse.read(dataset, dataset.keys[0]).images
    assert drawn is not None and drawn.shape[1:] == (48, 48, 3)
    episodes = browse.of_dataset(dataset)
    assert browse.run(page, episodes, after(20)).startswith("1 of 1")


def test_an_episode_can_be_seen_again_before_it_is_saved(page, steered, hurried, tmp_path):
    shown = []
    with recorder.record_into(tmp_path / "demos", steered.env, SEED) as kept:
        episode = teleop.OperatorEpisode(
            page, steered, teleop_target.Pilot(page, 1, np.eye(3), directed(steered, 3)), SEED
        )
        episode.begin(3, 0)
        far = episode.distances["goal"]
        for _ in range(10):
            episode.advance(kept)
        assert 0 < episode.distances["goal"] < far
        episode._stage.show = shown.append
        for _ in episode.replay(kept):
            assert kept.length == 10
    steps = [int(frame.step) for frame in shown]
    assert steps == [*range(1, 11), 10]


def test_what_was_discarded_is_nowhere(page, steered, hurried, tmp_path):
    root = tmp_path / "demos"
    presses = {
        20: lambda: press(page, "Discard the episode"),
        25: lambda: press(page, "Save the episode"),
    }
    with recorder.record_into(root, steered.env, SEED) as kept:
        teleop.run(page, steered, kept, after(40, presses), device=directed(steered, 0), seed=SEED)
        assert kept.kept == 0
    assert len(list(root.glob("episodes/*"))) <= 1  # motion after it


@pytest.mark.release
def test_a_policy_goes_from_trial_to_trial_until_a_hand_relieves_it(
    page, env, hurried, tmp_path, monkeypatch
):
    begun, begin = [], teleop.OperatorEpisode.begin

    def counted(self, configuration, trial):
        begun.append(trial)
        begin(self, configuration, trial)

    monkeypatch.setattr(teleop.OperatorEpisode, "begin", counted)
    policy = recorder.Relieved(agent.from_single(env.task.expert()), None, "digest", 2, 4)
    watched = []
    presses = {
        400: lambda: (watched.append(begun[-1]), press(page, "Pass control")),
        404: lambda: press(page, "Discard the episode"),
        410: lambda: press(page, "Pass control"),
        414: lambda: press(page, "Save the episode"),
    }
    with recorder.record_into(tmp_path / "relief", env, SEED, policy) as kept:
        teleop.run(page, recorder.steer(env, policy), kept, after(420, presses), seed=SEED)
        assert kept.saved == 1
        assert kept.next_trial(0) == watched[0] + 1
    assert begun == [*range(watched[0] + 1), watched[0], watched[0] + 1] and watched[0] >= 2


@pytest.mark.release
def test_in_the_view_too_a_hand_relieves_the_policy_where_it_is(page, env, hurried, tmp_path):
    root, seen = tmp_path / "relief", {}
    policy = recorder.Relieved(agent.from_single(env.task.expert()), None, "digest", 2, 4)
    steered = recorder.steer(env, policy)
    with recorder.record_into(root, env, SEED, policy) as kept:

        def look(name):
            seen[name] = [m.fields["actor"][0] for m in kept.moments]

        presses = {
            10: lambda: press(page, "Pass control"),
            20: lambda: press(page, "Pass control"),
            200: lambda: (look("shared"), press(page, "Save the episode")),
            210: lambda: press(page, "Pass control"),
            215: lambda: (look("again"), press(page, "Discard the episode")),
            220: lambda: press(page, "Save the episode"),
            230: lambda: look("alone"),
        }
        said = relief.run(page, "expert", steered, kept, after(232, presses), trocar=3, seed=SEED)
        assert kept.saved == 1 and said.endswith("1 episodes saved, 1 of them successful")
    # The hand acts from the very next step, the policy from its next plan; the end waits for Enter.
    shared = [0] * 10 + [2] * 10
    assert seen["shared"][:20] == shared and set(seen["shared"][20:]) == {0}
    assert set(seen["again"]) == {0, 2} and set(seen["alone"]) == {0}
    np.testing.assert_array_equal(load.actors(root), seen["shared"][9:])
    (record,) = (store.verify(root, key) for key in store.keys(root))
    assert record["source"] == "intervention" and (record["trocar"], record["trial"]) == (3, 0)


@pytest.mark.release
def test_trials_without_a_hand_follow_one_another_in_a_recorded_view(page, env, hurried, tmp_path):
    policy = recorder.Relieved(agent.from_single(env.task.expert()), None, "digest", 2, 4)
    begun = []
    with recorder.record_into(tmp_path / "relief", env, SEED, policy) as kept:
        steered = recorder.steer(env, policy)
        start = steered.start
        counted = steered._replace(start=lambda *given: (begun.append(given), start(*given))[1])
        said = relief.run(page, "expert", counted, kept, after(320), trocar=2, seed=SEED)
        assert kept.saved == 0
    trials = [trial for _, _, trial in begun]
    assert trials == [*range(len(trials))] and len(trials) >= 3
    assert {given[:2] for given in begun} == {(SEED, 2)} and "0 episodes saved" in said


def wristed(page, steered, start):
    """Returns a pilot of an arm with a wrist that rests, and its trocar."""
    pilot = teleop_target.Pilot(page, 1, np.eye(3), None, rcm.LARGE_NEEDLE_DRIVER)
    slot = steered.env.task.slots[0]
    bounds = [teleop_target.bounds(slot, start[0, 1:4], rcm.LARGE_NEEDLE_DRIVER)]
    reference = np.float32(slot.p_world_ref)
    trocar = rcm.trocar_frame(rcm.trocar_from_position([0.02, 0.01, 0.15], reference), reference)
    trocar = trocar._replace(roll_zero=np.float32(0.0))
    pilot.rest(start, np.ones(1), bounds, [trocar])
    return pilot, trocar


def test_the_handle_turns_a_wrist_and_moves_its_tip(page, steered):
    pilot, trocar = wristed(page, steered, np.array([[0.1, 0.0, 0.0, 0.06, 0.3, -0.2]]))
    space = rcm.rcm6(rcm.LARGE_NEEDLE_DRIVER)
    handle = pilot._handle._handle

    def tip():
        action = np.float32(pilot.targets[0].goal[tip_handle.TO_RCM6])
        return space.decode(action, trocar)[0]

    def at(pose):
        turned = Rotation.from_quat(np.array(handle.wxyz), scalar_first=True)
        np.testing.assert_allclose(turned.as_matrix(), pose.R, atol=1e-5)
        np.testing.assert_allclose(handle.position, pose.p, atol=1e-6)

    start = tip()
    at(start)
    pilot.read(1 / 30)
    assert not pilot.has_moved
    by = Rotation.from_euler("xyz", [0.3, -0.2, 0.4]).as_matrix()
    for R, p in ((by @ start.R, start.p), (by @ start.R, start.p + np.float32([0.01, 0, -0.02]))):
        turned = Rotation.from_matrix(np.asarray(R, np.float64))  # as a drag does
        handle.wxyz, handle.position = turned.as_quat(scalar_first=True), p
        pilot.read(1 / 30)
        pose = tip()
        np.testing.assert_allclose(pose.R, R, atol=1e-5)
        np.testing.assert_allclose(pose.p, p, atol=1e-6)
    # Beyond the limits the target stays within them, and the released handle returns to it.
    handle.wxyz = Rotation.from_euler("xyz", [2.5, 0.0, 0.0]).as_quat(scalar_first=True)
    pilot.read(1 / 30)
    limits = [rcm.LARGE_NEEDLE_DRIVER.pitch, rcm.LARGE_NEEDLE_DRIVER.yaw]
    assert (np.abs(pilot.targets[0].goal[4:]) <= limits).all()
    at(tip())


def test_keys_bend_a_wrist(page, steered):
    start, wrist = np.array([[0.0, 0.0, 0.0, 0.06, 0.0, 0.0]]), rcm.LARGE_NEEDLE_DRIVER
    pilot, _ = wristed(page, steered, start)
    turn = teleop_target.KEY_TURN
    for key in ("Pitch up", "Pitch up", "Yaw right", "Up"):
        press(page, key)
    pilot.read(1 / 30)
    moved = pilot.targets[0].goal - start[0]
    up = teleop_target.KEY_STEP
    np.testing.assert_allclose(moved, [0, 0, 0, up, 2 * turn, -turn], atol=1e-12)
    for _ in range(60):
        press(page, "Pitch up")
    pilot.read(1 / 30)
    assert pilot.targets[0].goal[4] == pytest.approx(wrist.pitch)


def test_the_hands_of_the_page(page, steered, hurried, tmp_path):
    """Keys and handle move the tip by their increments, and without the clutch not at all."""
    from starjax.addons.viewer.teleop_target import KEY_STEP, Pilot

    pilot = Pilot(page, 1, np.eye(3), None)
    start = np.array([[0.0, 0.0, 0.0, 0.06]])
    bounds = [teleop_target.bounds(steered.env.task.slots[0], start[0, 1:])]

    def asked(*keys):
        for key in keys:
            press(page, key)
        pilot.read(1 / 30)
        return pilot.targets[0].goal - start[0]

    pilot.rest(start, np.ones(1), bounds)
    np.testing.assert_allclose(asked(), 0)
    assert not pilot.has_moved
    np.testing.assert_allclose(asked("To the right", "Up", "Up"), [0, KEY_STEP, 0, 2 * KEY_STEP])
    handle = pilot._handle._handle
    handle.position = handle.position + np.array([0.0, 0.01, 0.0])  # as a drag does
    np.testing.assert_allclose(asked()[2], 0.01)
    press(page, "Clutch")
    np.testing.assert_allclose(asked("To the left"), [0, KEY_STEP, 0.01, 2 * KEY_STEP])
    press(page, "Open or close the jaws")
    pilot.read(1 / 30)
    assert pilot.targets[0].gripper == -1.0
