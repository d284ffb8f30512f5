"""A robot's loop over a bad network: the next command, without a jump."""

import collections
import contextlib
import dataclasses
import socket
import threading
import time

import jax
import mistakes
import numpy as np
import pytest
import served
from scipy.spatial.transform import Rotation

from starjax import deploy, rcm
from starjax.core.errors import UsageError
from starjax.core.types import Command, Pose
from starjax.deploy import batching, connection_pool, plan_executor, wire
from starjax.deploy.connection import Connection, Reply
from starjax.policies.monitor import record, scores
from starjax.sim import registries

HORIZON, EXECUTE = 16, 8
WHERE = np.asarray(rcm.trocar_position(served.PORT, np.float32([0.0, 0.0, 0.15])))


def poses(roll, depth):
    """Tools straight down through the trocar, `[T]`."""
    pose = rcm.pose_on_manifold(np.float32([0.0, 0.0, -1.0]), np.float32(roll), depth, WHERE)
    return Pose(*(np.asarray(x) for x in pose))


def plan(number):
    """Command t of plan `number` turns the tool by 0.1 number + 0.001 t, its mark."""
    roll = 0.1 * number + 1e-3 * np.arange(HORIZON)
    return Command(poses(roll, np.full(HORIZON, 0.1)), np.zeros(HORIZON, np.float32))


def which(command):
    """(number, t) of a command."""
    roll = float(rcm.roll_of(command.pose.R))
    number = int((roll + 1e-4) / 0.1)
    return number, round(1e3 * (roll - 0.1 * number))


def followed(latency, steps, ahead=None):
    """Plans that take `latency(n)` control steps each; (plan, command) of every step, the report.

    Held steps are None.
    """
    executor = plan_executor.PlanExecutor(WHERE, HORIZON, EXECUTE, ahead, deploy.Limits(30.0, 90.0))
    executor.begin(poses(0.0, 0.1), 1.0)
    given, number, due = [], 0, None
    for t in range(steps):
        for _ in range(2):
            if due is not None and t >= due:
                executor.on_plan(plan(number))
                due = None
            if executor.needs_plan:
                number += 1
                executor.on_request()
                due = t + latency(number)
        held = executor.report.held
        command = executor.step()
        given.append(None if executor.report.held > held else which(command))
    return given, executor.report


def test_without_delay_plans_are_carried_out_as_by_an_evaluation():
    given, report = followed(lambda n: 0, 32, ahead=0)
    assert given == [(n, t) for n in range(1, 5) for t in range(8)]
    assert (report.missed, report.held, report.stretched, report.limited) == (0, 0, 0, 0)


@pytest.mark.parametrize("latency", [1, 3, 7])
def test_it_asks_ahead_so_that_no_command_is_missed(latency):
    given, report = followed(lambda n: latency, 100)
    assert given[:latency] == [None] * latency and report.held == latency
    assert report.missed == 0 and report.stretched == 0
    # From question to answer the robot moves on: the new plan begins where it then is.
    first = 0
    wanted = []
    while len(wanted) < 100 - latency:
        number = len(wanted) // EXECUTE + 1
        wanted += [(number, t) for t in range(first, first + EXECUTE)]
        first = min(latency + 1, EXECUTE - 1)  # requested when the previous one began
    assert given[latency:] == wanted[: 100 - latency]


def test_a_late_plan_stretches_the_old_one_and_then_the_robot_holds():
    given, report = followed(lambda n: 0 if n == 1 else 30, 60, ahead=0)
    assert given[:16] == [(1, t) for t in range(16)]
    assert given[16:38] == [None] * 22
    # Eight commands passed since the question, the others were held: plans do not age meanwhile.
    assert given[38:46] == [(2, t) for t in range(8, 16)]
    assert report.missed == 1 + 1 and report.held >= 22 and report.stretched == 8


def test_of_a_plan_that_comes_very_late_only_the_rest_is_followed():
    given, report = followed(lambda n: 0 if n == 1 else 16, 60, ahead=8)
    # The robot waits where the late one still has as many commands as a plan should have.
    assert given[:17] == [(1, t) for t in range(9)] + [None] * 8
    assert given[17:25] == [(2, t) for t in range(8, 16)]
    assert given[25:35] == [None] * 9 + [(3, 7)] and report.missed == 4
    assert report.lost == report.refused == 0


@pytest.mark.parametrize("seed", range(3))
def test_commands_keep_to_the_manifold_and_do_not_jump(seed):
    """Whatever the plans are: far apart, off the manifold, not rotations."""
    rng, limits = np.random.default_rng(seed), deploy.Limits()
    executor = plan_executor.PlanExecutor(WHERE, HORIZON, EXECUTE, None, limits)
    executor.begin(poses(0.0, 0.1), 0.3)
    commands = [executor.last]
    for _ in range(150):
        if executor.needs_plan:
            executor.on_request()
        if rng.random() < 0.3 and executor._is_pending:
            axis = rng.normal(size=(HORIZON, 3)) * [0.5, 0.5, 0.1] - [0.0, 0.0, 1.0]
            roll, depth = rng.uniform(-3.0, 3.0, HORIZON), rng.uniform(0.02, 0.2, HORIZON)
            pose = rcm.pose_on_manifold(np.float32(axis), roll, depth, WHERE)
            R, p = (np.array(x) for x in pose)
            spoilt = rng.integers(6)
            p += 1e-3 * (spoilt == 1)
            R *= 1.0 + 0.1 * (spoilt == 2)
            p[3] = np.where(spoilt == 3, np.nan, p[3])
            executor.on_plan(Command(Pose(R, p), rng.normal(size=HORIZON)))
        commands.append(executor.step())
    assert executor.report.refused > 0 and executor.report.limited > 0
    R, p = (np.stack([c.pose[n] for c in commands]).astype(np.float64) for n in (0, 1))
    off = np.linalg.norm(np.cross(p - WHERE, R[:, :, 2]), axis=-1)
    assert off.max() < 1e-6 and ((p - WHERE) * R[:, :, 2]).sum(-1).min() > 0.0
    assert np.linalg.norm(np.diff(p, axis=0), axis=-1).max() <= limits.per_step[0] * (1 + 1e-4)
    cos = (np.einsum("tij,tij->t", R[1:], R[:-1]) - 1.0) / 2.0
    assert np.arccos(np.clip(cos, -1.0, 1.0)).max() <= limits.per_step[1] * (1 + 1e-2)
    assert all(-1.0 <= c.gripper <= 1.0 for c in commands)


@pytest.mark.parametrize("spoil", ["off", "above", "stretched", "mirrored"])
def test_a_plan_that_misses_the_trocar_is_not_followed(spoil):
    executor = plan_executor.PlanExecutor(WHERE, HORIZON, EXECUTE, None, deploy.Limits())
    executor.begin(poses(0.0, 0.1), 1.0)
    good = plan(0)
    R, p = np.array(good.pose.R), np.array(good.pose.p)
    p[5, 0] += 2e-4 * (spoil == "off")
    p[5, 2] += 0.2 * (spoil == "above")
    R[5] *= 1.01 if spoil == "stretched" else 1.0
    R[5, :, 0] *= -1.0 if spoil == "mirrored" else 1.0
    executor.on_request()
    executor.on_plan(good._replace(pose=Pose(R, p)))
    assert executor.report.refused == 1 and executor.report.latencies == []
    executor.step()
    assert executor.report.held == 1 and executor.needs_plan  # it asks again
    executor.on_request()
    executor.on_plan(good)
    executor.step()
    assert executor.report.refused == 1 and executor.report.plans == 1


def test_a_tool_that_does_not_go_through_the_trocar_is_not_moved():
    executor = plan_executor.PlanExecutor(WHERE, HORIZON, EXECUTE, None, deploy.Limits())
    pose = poses(0.0, 0.1)
    executor.begin(pose._replace(p=pose.p + np.float32([0.002, 0.0, 0.0])), 1.0)
    held = executor.step()
    assert float(rcm.rcm_error(held.pose, WHERE)) < 1e-6
    assert np.linalg.norm(held.pose.p - pose.p) < 0.005
    with pytest.raises(UsageError) as caught:
        executor.begin(pose._replace(p=pose.p + np.float32([0.03, 0.0, 0.0])), 1.0)
    assert caught.value.argument == "observation.pose"


@pytest.mark.parametrize("name", ["R", "p", "gripper"])
def test_what_is_not_finite_is_no_first_command(name):
    pose = poses(0.0, 0.1)
    given = {"R": np.array(pose.R), "p": np.array(pose.p), "gripper": np.ones(())}
    given[name] = np.full_like(given[name], np.nan)
    executor = plan_executor.PlanExecutor(WHERE, HORIZON, EXECUTE, None, deploy.Limits())
    with mistakes.of(f"observation.{name}", "nan"):
        executor.begin(deploy.Pose(given["R"], given["p"]), given["gripper"])


@pytest.mark.parametrize(("ahead", "limits"), [(9, (0.1, 0.1)), (-1, (0.1, 0.1)), (0, (0.0, 0.1))])
def test_settings_that_cannot_be_are_named(ahead, limits):
    with pytest.raises(UsageError):
        plan_executor.PlanExecutor(WHERE, HORIZON, EXECUTE, ahead, deploy.Limits(*limits))


@pytest.fixture(scope="module")
def batches(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(registries, "tasks", registries.Registry("task", {"fake": "fakes:TASK"}))
        made = batching.Batches(served.policy(tmp_path_factory.mktemp("client")), max_robots=1)
        made.warm_up()
        yield made


class Robot:
    """It reaches each command at once."""

    def __init__(self):
        self.seen, self.commands = served.moment(), collections.deque()

    def measure(self):
        return self.seen

    def send(self, command):
        self.commands.append(command)
        self.seen = self.seen.replace(pose=command.pose, gripper=command.gripper)


def client_of(where, **options):
    options = {"api_key": served.KEY, "key": jax.random.key(0), **options}
    return deploy.Client(f"{where[0]}:{where[1]}", served.PORT, **options)


class AtOnce(Connection):
    """Waits for every answer: latency zero."""

    def poll(self):
        reply = super().poll()
        while reply is None and self.waits:
            reply = super().poll()
        self.waits = False
        return reply

    waits = False

    def send(self, value):
        self.waits = True
        super().send(value)


def test_a_loop_over_the_socket_is_the_loop_in_the_process(batches):
    policy, key, robot = batches.policy, jax.random.key(0), Robot()
    execute = policy.settings.execute
    options = {"ahead": 0, "connect": AtOnce, "limits": deploy.Limits(30.0, 93.0)}
    with served.running(batches) as (where, _), client_of(where, **options) as client:
        for _ in range(3 * execute):
            robot.send(client.step(robot.measure()))
        assert client.report.missed == client.report.held == 0
    here = Robot()
    history = [here.measure()] * 2
    for decision in range(3):
        seen = jax.tree.map(lambda *x: np.stack(x), *history[-2:])
        made = policy(jax.random.fold_in(key, decision), seen, rcm.Trocar(*served.PORT))
        made = jax.tree.map(np.asarray, made)
        for t in range(execute):
            here.send(jax.tree.map(lambda x: x[t], made))  # noqa: B023
            history.append(here.measure())
    for got, wanted in zip(robot.commands, here.commands, strict=True):
        np.testing.assert_allclose(got.pose.p, wanted.pose.p, atol=1e-4)
        np.testing.assert_allclose(got.gripper, wanted.gripper, atol=1e-3)


def clock_monitor(seconds):
    """A monitor with an alarm after so many seconds, and no other."""
    return record.Monitor(
        center=np.zeros(len(scores.NAMES)),
        width=np.array([1e9, 1e9, 1.0, 1e9, 1e9, 1e9]),
        threshold=seconds,
        clock_s=seconds,
        alpha=0.05,
        count=20,
        settings=scores.ScoreSettings(EXECUTE, 30.0, 6),
        digest="weights",
    )


def test_an_alarm_holds_the_robot_on_the_manifold_until_it_is_resumed(batches, monkeypatch):
    watched = dataclasses.replace(batches.policy, monitor=clock_monitor(0.9))
    monkeypatch.setattr(batches, "policy", watched)
    robot, options = Robot(), {"ahead": 0, "connect": AtOnce, "limits": deploy.Limits(1.0, 3.1)}
    with served.running(batches) as (where, _):
        with client_of(where, **options) as client:
            assert client.metadata["monitor"]["clock_s"] == 0.9
            for _ in range(50):
                robot.send(client.step(robot.measure()))
            # 0.9 s are 27 control steps; the next decision is after the 32nd.
            assert client.report.plans == 4 and client.report.held == 50 - 32
            assert client.report.alarms == 1 and "clock" in client.report.alarm
            held = list(robot.commands)[31:]
            for command in held:
                np.testing.assert_array_equal(command.pose.p, held[0].pose.p)
            assert float(rcm.rcm_error(held[-1].pose, client.p_world_trocar)) < 1e-6
            client.resume()
            for _ in range(50):
                robot.send(client.step(robot.measure()))
            assert client.report.alarms == 2 and client.report.plans == 8
        with client_of(where, **options, is_watched=False) as client:
            for _ in range(50):
                robot.send(client.step(robot.measure()))
            assert client.report.alarms == client.report.held == 0


def test_an_alarm_drops_the_next_plan_too():
    executor = plan_executor.PlanExecutor(WHERE, HORIZON, EXECUTE, 8, deploy.Limits(1.0, 3.0))
    executor.begin(poses(0.0, 0.1), 1.0)
    for number in (1, 2):
        executor.on_request()
        assert executor.on_plan(plan(number))
        last = executor.step()
    executor.on_alarm("too long")
    for _ in range(20):
        assert not executor.needs_plan
        np.testing.assert_array_equal(executor.step().pose.R, last.pose.R)
    assert (executor.report.alarm, executor.report.missed) == ("too long", 0)
    executor.resume()
    assert executor.needs_plan


def driven_until(holds, client, robot, seconds=60.0):
    """Whether it holds in time, however busy the machine is."""
    deadline = time.monotonic() + seconds
    while not holds() and time.monotonic() < deadline:
        client.run(robot, 0.1)
    return holds()


def test_a_server_that_goes_and_comes_back_is_found_again(batches):
    robot = Robot()
    with served.running(batches) as (where, _):
        client = client_of(where)
        assert driven_until(lambda: client.report.plans > 0, client, robot)
    plans = client.report.plans
    client.run(robot, 1.0)  # no server: it holds
    assert client.report.plans <= plans + 1 and client.report.held > 5
    with served.running(batches, port=where[1]):
        assert driven_until(lambda: client.report.plans > plans + 1, client, robot)
        assert client.reconnected >= 1
        client.close()
    steps = np.diff([c.pose.p for c in robot.commands], axis=0)
    assert np.linalg.norm(steps, axis=-1).max() <= deploy.Limits().per_step[0] * (1 + 1e-4)


def test_another_policy_at_the_address_is_not_asked(batches, monkeypatch):
    with served.running(batches) as (where, _):
        client = client_of(where, timeout_s=0.5)
    monkeypatch.setattr(type(batches.policy), "digest", "another")
    with served.running(batches, port=where[1]):
        deadline = time.monotonic() + 60.0
        while "another" not in client._connection.fault and time.monotonic() < deadline:
            time.sleep(0.05)
        assert "another" in client._connection.fault and not client._connection.is_up
        client.close()


@pytest.mark.parametrize(
    ("about", "argument"),
    [
        ({"api_key": "wrong"}, "address"),
        ({"trocar": rcm.Trocar(0.01, 80.0, 0.0)}, None),
        ({"trocar": (0.0, 0.15)}, "trocar"),
        ({"trocar": (0.02, 1.57, 0.8)}, "trocar"),  # parameters where a position is meant
    ],
)
def test_what_cannot_be_served_is_said_at_the_start(batches, about, argument):
    trocar = about.pop("trocar", served.PORT)
    threads = threading.active_count()
    with served.running(batches) as (where, _):
        given = {"api_key": served.KEY, "wait_s": 1.0, **about}
        with pytest.raises(ValueError) as caught:
            deploy.Client(f"{where[0]}:{where[1]}", trocar, **given)
        assert argument is None or caught.value.argument == argument
    assert threading.active_count() <= threads


@pytest.mark.parametrize(
    "lie",
    [
        {"control_hz": 3000.0},
        {"control_hz": float("nan")},
        {"control_hz": -30.0},
        {"horizon": 10**9},
        {"execute": 0},
        {"execute": "8"},
    ],
)
def test_numbers_of_a_server_are_checked(batches, lie):
    class Liar(Connection):
        def _greet(self, frame):
            super()._greet(frame)
            self.metadata |= lie

    with served.running(batches) as (where, _), pytest.raises(UsageError) as caught:
        client_of(where, connect=Liar)
    assert caught.value.argument == "address"


def test_answers_that_are_none_are_refused_and_it_holds(batches):
    """For a server that sends no plan of this policy."""

    class Liar(Connection):
        lies = iter([{}, {"R": 1}, None, "text", wire.unpack(wire.pack({"p": np.zeros(3)}))])

        def poll(self):
            reply = super().poll()
            return None if reply is None else Reply(next(self.lies, {}))

    robot = Robot()
    with served.running(batches) as (where, _), client_of(where, connect=Liar) as client:
        assert driven_until(lambda: client.report.refused >= 5, client, robot)
        assert client.report.plans == 0
        assert client.report.held == client.report.steps
    assert len({c.pose.p.tobytes() for c in robot.commands}) == 1


def test_periods_that_take_too_long_are_counted(batches):
    robot = Robot()

    def slow():
        time.sleep(0.05)
        return robot.seen

    with served.running(batches) as (where, _), client_of(where) as client:
        robot.measure = slow
        assert client.run(robot, 0.3).overran == client.report.steps == 9
        stopped = client.run(robot, 5.0, should_stop=lambda: client.report.steps >= 12)
        assert stopped.steps == 12


def test_a_proxy_of_the_environment_is_not_used(batches, monkeypatch):
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))  # bound and not listening: every connection is refused
        proxy = f"http://127.0.0.1:{closed.getsockname()[1]}"
        for name in ("http_proxy", "https_proxy", "all_proxy"):
            monkeypatch.setenv(name, proxy)
        monkeypatch.setenv("no_proxy", "")
        with served.running(batches) as (where, _):
            with client_of(where, wait_s=10.0) as client:
                assert client.metadata["method"] == "stardiff"
            address = f"ws://{where[0]}:{where[1]}"
            pool = connection_pool.ConnectionPool(address, served.KEY)
            assert pool.metadata["method"] == "stardiff"


def moved_on(batches, **options):
    """A robot that is on its way, its client, and the end of both."""
    stack = contextlib.ExitStack()
    where, _ = stack.enter_context(served.running(batches))
    client = stack.enter_context(client_of(where, **options))
    robot = Robot()
    assert driven_until(lambda: client.report.plans > 0, client, robot)
    return stack, client, robot


def elsewhere(pose, angle=0.25):
    """The same tool, turned about the trocar."""
    R = np.array(Rotation.from_rotvec([angle, 0.0, 0.0]).as_matrix(), np.float32)
    return Pose(R @ pose.R, WHERE + R @ (pose.p - WHERE))


def test_an_arm_that_comes_back_elsewhere_waits_for_a_person(batches):
    stack, client, robot = moved_on(batches)
    with stack:
        sent = len(robot.commands)
        robot.seen = robot.seen.replace(pose=elsewhere(robot.seen.pose))
        assert np.linalg.norm(robot.seen.pose.p - robot.commands[-1].pose.p) > 0.01
        client.run(robot, 1.0)  # its program is back: nothing is sent
        assert len(robot.commands) == sent and client.report.silent == 30
        assert client.report.fault.startswith("following") and client.report.plans >= 1
        client.restart(robot.measure())
        first = client.step(robot.measure())
        assert np.linalg.norm(first.pose.p - robot.seen.pose.p) < 1e-4
        robot.send(first)
        plans = client.report.plans
        assert driven_until(lambda: client.report.plans > plans, client, robot)
        steps = np.diff([one.pose.p for one in list(robot.commands)[sent:]], axis=0)
        assert np.linalg.norm(steps, axis=-1).max() <= deploy.Limits().per_step[0] * (1 + 1e-4)


def test_a_plan_from_before_a_restart_is_not_executed():
    executor = plan_executor.PlanExecutor(WHERE, HORIZON, EXECUTE, None, deploy.Limits())
    executor.begin(poses(0.0, 0.1), 1.0)
    executor.on_request()
    executor.forget()
    assert executor.last is None
    executor.begin(poses(0.5, 0.08), 1.0)
    assert not executor.needs_plan  # one reply is due
    assert not executor.on_plan(plan(1)) and executor.needs_plan
    np.testing.assert_allclose(executor.step().pose.p, poses(0.5, 0.08).p, atol=1e-6)
    executor.on_request()
    assert executor.on_plan(plan(2)) and executor.step() and executor.report.plans == 1


def test_frozen_stamps_silence_and_frozen_images_hold(batches):
    now = [100.0]
    stack, client, robot = moved_on(batches, clock=lambda: now[0])
    with stack:
        robot.seen = robot.seen.replace(stamp=100.0, image_stamp=100.0)
        client.step(robot.measure())
        assert client.report.stale == 0 and not client.doubts
        plans = client.report.plans
        robot.seen, now[0] = robot.seen.replace(stamp=100.3), 100.3
        for _ in range(60):  # no new plan after that which may be on its way
            robot.send(client.step(robot.measure()))
            time.sleep(0.01)
        assert client.report.stale == 60 and client.report.plans <= plans + 1
        assert [doubt.kind for doubt in client.doubts] == ["view"]
        last = robot.commands[-1]
        assert client.step(robot.measure()).pose.p.tolist() == last.pose.p.tolist()
        robot.seen = robot.seen.replace(image_stamp=100.3)
        now[0] = 100.6
        assert client.step(robot.measure()) is None and client.report.silent == 1
        robot.seen = robot.seen.replace(stamp=100.6, image_stamp=100.6)
        assert client.step(robot.measure()) is None  # until a person says so
        client.restart(robot.measure())
        assert client.step(robot.measure()) is not None


def test_a_trocar_that_moves_is_noticed_and_taken_at_a_restart(batches):
    stack, client, robot = moved_on(batches)
    with stack:
        there = (WHERE + np.float32([0.0, 0.002, 0.0])).astype(np.float32)
        robot.seen = robot.seen.replace(p_world_trocar=there)
        assert client.step(robot.measure()) is None
        assert client.report.fault.startswith("moved trocar")
        with pytest.raises(UsageError):
            client.restart(robot.measure())
        client.restart(robot.measure(), there)
        command = client.step(robot.measure())
        assert float(rcm.rcm_error(command.pose, there)) < 1e-6


def test_a_server_that_dies_before_the_first_request_is_noticed(batches):
    robot = Robot()
    with served.running(batches) as (where, _):
        client = client_of(where)
    deadline = time.monotonic() + 60.0
    while not client.report.fault and time.monotonic() < deadline:
        client.run(robot, 0.1)
    assert client.report.lost == 1 and client.report.plans == 0
    assert client.report.held == client.report.steps
    client.close()


@pytest.mark.parametrize("bounds", [{"max_following": 0.0}, {"max_age_s": np.nan}])
def test_bounds_are_more_than_nothing(bounds):
    with mistakes.of(f"tolerances.{next(iter(bounds))}"):
        deploy.Client("nowhere", served.PORT, tolerances=deploy.Tolerances(**bounds))
