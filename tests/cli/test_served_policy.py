"""A served policy evaluated by its address: the result of the same policy in this process."""

import contextlib
import functools
import json
import queue
import threading

import jax
import mistakes
import numpy as np
import pytest
import served
import stubs
from websockets.sync import server as sockets

from starjax import rcm
from starjax.cli import evaluate, stress, sweep
from starjax.core import config
from starjax.core.types import Command, Pose
from starjax.deploy import approach, batching, connection_pool, inputs, wire
from starjax.deploy import served as serving
from starjax.evaluation import evaluate as evaluating
from starjax.policies import in_env
from starjax.policies.monitor import record, scores
from starjax.sim import names
from starjax.sim.rollouts import agent

TRIALS = ["--eval.trials=1", "--eval.time-limit-s=1", "--no-video"]
SAMPLE, PARAMS = stubs.make_policy()
PROGRAM = jax.jit(functools.partial(SAMPLE, PARAMS, 1.0))


class Stub:
    """The network of `stubs` as `deploy.Deployed`."""

    method, digest, monitor = "dp_ee", "d" * 64, None
    max_off_trocar = np.inf  # the network holds no trocar
    scene = names.SceneNames("reach", (), (), ())
    settings = config.PolicyConfig(observation="state", obs_horizon=2, horizon=6, execute=4)
    input_spec = inputs.InputSpec(2, (), stubs.P_WORLD_REF[0], False, 0, (), 12)

    def plan(self, keys, sensors, trocar):
        pose = Pose(sensors.pose.R[:, :, None], sensors.pose.p[:, :, None])
        sensors = sensors._replace(pose=pose, gripper=sensors.gripper[:, :, None])
        plan = jax.tree.map(lambda x: x[:, :, 0], PROGRAM(keys, sensors, None))
        return plan, approach.StartOffset(*[np.zeros(len(keys))] * 2)

    def check_first(self, offset):
        pass


@pytest.fixture(autouse=True)
def simulated(tmp_path, monkeypatch):
    monkeypatch.setattr(in_env.sim_env, "make", lambda *_, **__: stubs.make_env())
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def address(monkeypatch):
    monkeypatch.setenv("STARJAX_API_KEY", served.KEY)
    with served.running(batching.Batches(Stub(), 2)) as ((host, port), _):
        yield f"ws://{host}:{port}"


@contextlib.contextmanager
def openpi(infer, metadata):
    """A server as openpi's; `infer` maps a request to an answer or a text."""

    opened = []

    def work(connection):
        opened.append(connection)
        connection.send(wire.pack(metadata))
        for frame in connection:
            reply = infer(wire.unpack(frame))
            connection.send(reply if isinstance(reply, str) else wire.pack(reply))

    with sockets.serve(work, "127.0.0.1", 0, compression=None) as up:
        thread = threading.Thread(target=up.serve_forever)
        thread.start()
        try:
            yield f"ws://127.0.0.1:{up.socket.getsockname()[1]}"
        finally:
            up.shutdown()
            for connection in opened:
                connection.close()
            thread.join()


def stay(request, horizon=5):
    return {"actions": np.tile(request["observation/state"], (horizon, 1))}


PLAIN = {"scene": {"task": "reach"}, "observation": "state"}


def result(out):
    return json.loads((out / "result.json").read_text())


def test_it_is_scored_as_in_this_process(address, tmp_path):
    assert evaluate.main(["--policy", address, "--out", "here", *TRIALS]) == 0
    found = result(tmp_path / "here")
    env = stubs.make_env()
    local = evaluating.evaluate(
        tmp_path / "local",
        env,
        agent.from_policy(SAMPLE, 2, 4),
        (PARAMS, 1.0),
        env.task.trocars,
        evaluating.EvaluationSettings(trials=1, seed=0, time_limit_s=1.0),
    )
    assert [row["success"] for row in found["trials"]] == local.success.tolist()
    assert [row["steps"] for row in found["trials"]] == local.steps.tolist()
    largest = [row["rcm_max_mm"] for row in found["trials"]]
    np.testing.assert_allclose(largest, 1e3 * local.rcm_max, atol=1e-3)
    assert 0 < local.success.sum() < 12
    assert found["server"]["address"] == address and found["weights"] == Stub.digest
    assert found["server"]["metadata"]["horizon"] == 6 and found["method"] == "dp_ee"


def late(execute):
    """A monitor with an alarm at the first decision after half a second."""
    width = np.where(np.array(scores.NAMES) == "clock", 1.0, 1e9)
    settings = scores.ScoreSettings(execute, 30.0, 2)
    return record.Monitor(np.zeros(len(width)), width, 0.5, 0.5, 0.1, 20, settings, "weights")


def test_the_monitor_of_a_server_scores_its_trials(tmp_path, monkeypatch):
    monkeypatch.setenv("STARJAX_API_KEY", served.KEY)
    monkeypatch.setattr(Stub, "monitor", late(execute=4))
    with served.running(batching.Batches(Stub(), 2)) as ((host, port), _):
        policy = ["--policy", f"ws://{host}:{port}", *TRIALS[:2]]
        assert evaluate.main([*policy, "--out", "here", "--no-video"]) == 0
        offset = ["--disturbance", "trocar_offset", "--levels", "5", "--out", "wrong"]
        assert stress.main([*policy, *offset]) == 0
    found = result(tmp_path / "here")
    for name, is_success in (("announced", False), ("false_alarms", True)):
        steps = [row["steps"] for row in found["trials"] if row["success"] == is_success]
        raised = sum(count > 16 for count in steps)  # steps at 30 Hz; decisions are after every 4th
        assert (raised, len(steps)) == tuple(found["alarms"][name].values())[:2]
    assert found["alarms"]["false_alarms"]["successes"]
    stressed = json.loads((tmp_path / "wrong" / "stress.json").read_text())
    level = stressed["disturbances"]["trocar_offset"]["levels"]["5"]
    assert level["alarms"]["announced"]["trials"] == 12 - level["strict"]["successes"]


def test_a_sweep_of_a_server(address, tmp_path):
    assert sweep.main(["--policy", address, "--trocars=2", "--eval.time-limit-s=0.5"]) == 0
    (file,) = tmp_path.glob("runs/sweep/*/sweep.json")
    assert json.loads(file.read_text())["weights"] == Stub.digest


def test_plain_frames_of_openpi(tmp_path):
    requests = queue.SimpleQueue()

    def infer(request):
        requests.put(request)
        return stay(request)

    with openpi(infer, PLAIN) as address:
        evaluate.main(["--policy", address, "--out", "here", *TRIALS])
    found, request = result(tmp_path / "here"), requests.get()
    assert found["method"] == "served" and found["config"]["policy"]["execute"] == 5
    assert request["observation/state"].shape == (8,) and request["prompt"] == "reach"
    assert request["observation/environment_state"].shape == (12,)
    # A position, as the export has it; the request of the test is in the nominal trocar.
    np.testing.assert_allclose(request["observation/trocar"], stubs.P_WORLD_REF[0], atol=1e-6)


def test_images_reach_a_server_and_its_pictures_are_the_environments(tmp_path, monkeypatch):
    """Through the callback: one picture per request, that of the lane's own state."""
    made = stubs.make_env("image")
    monkeypatch.setattr(in_env.sim_env, "make", lambda *_, **__: made)
    requests = queue.SimpleQueue()

    def infer(request):
        requests.put(request)
        return stay(request)

    about = {"scene": {"task": "reach"}, "image_size": 32}
    with openpi(infer, about) as address:
        who = serving.connect(address)
        in_closed_loop(who, tmp_path)
    requests.get()  # the request of the test
    seen = [requests.get() for _ in range(requests.qsize())]
    assert len(seen) >= 12 and who.server.refused == 0
    for request in seen:
        tip, image = request["observation/state"][:3], request["observation/image"]
        assert image.dtype == np.uint8 and image.shape == (6, 6, 3)  # the stub's size
        shade = np.float32(tip) * 1000 + 128  # the stub's first three rows
        np.testing.assert_allclose(image[:3, 0, 0], shade, atol=1.5)
    assert len({request["observation/image"].tobytes() for request in seen}) >= 12


def test_disturbances_of_a_stress_test_reach_the_server(tmp_path):
    """The measured trocar is off by the level; the tool rests in the true one."""
    requests = queue.SimpleQueue()

    def infer(request):
        requests.put(request)
        return stay(request)

    argv = "--disturbance trocar_offset --levels 0 5 --eval.trials 1 --eval.time-limit-s 0.3"
    with openpi(infer, PLAIN) as address:
        stress.main(["--policy", address, "--out", "here", *argv.split()])
    found = json.loads((tmp_path / "here" / "stress.json").read_text())
    assert found["weights"] and found["server"]["address"] == address
    requests.get()
    places = np.array([requests.get()["observation/trocar"] for _ in range(requests.qsize())])
    true = np.asarray(rcm.trocar_position(stubs.trocars(*range(12)), stubs.P_WORLD_REF[:1]))[:, 0]
    off = np.linalg.norm(places[:, None] - true, axis=-1).min(axis=1)
    assert {round(1e3 * distance) for distance in off} == {0, 5}


def test_refused_plans_hold_and_are_counted(tmp_path):
    asked = []

    def infer(request):
        asked.append(request)
        bad = [stay(request), "no plan", {"actions": np.full((5, 8), np.nan)}]
        return bad[min(len(asked) - 1, 1 + len(asked) % 2)]

    with openpi(infer, PLAIN) as address:
        who = serving.connect(address)
        table = in_closed_loop(who, tmp_path)
    assert who.server.refused == len(asked) - 1 > 0
    assert not table.success.any() and table.rcm_max.max() < 1e-6


def in_closed_loop(who, folder):
    settings = evaluating.EvaluationSettings(trials=1, seed=0, time_limit_s=0.5)
    with who.faults():
        return evaluating.evaluate(
            folder / "e", who.env, who.agent(), (np.zeros(1, bool), None),
            who.env.task.trocars, settings,
        )  # fmt: skip


def test_a_lost_server_ends_it_in_one_line(tmp_path):
    asked = []

    def infer(request):
        asked.append(request)
        if len(asked) > 3:
            raise RuntimeError
        return stay(request)

    with openpi(infer, PLAIN) as address:
        who = serving.connect(address)
        with mistakes.of(address):
            in_closed_loop(who, tmp_path)
    assert isinstance(who.server.fault, connection_pool.LostServer)


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"scene": {}}, "greeting.scene.task"),
        ({"control_hz": 50.0}, "greeting.control_hz"),
        ({"batch": 0}, "greeting.batch"),
        ({"observation": "smell"}, "greeting"),
        ({"execute": 9}, "greeting.execute"),
        ({"action_space": "joints"}, "greeting.action_space"),
        ({"action_space": "rcm4"}, "answer.actions"),  # and eight columns
        ({"monitor": 5}, "greeting.monitor"),
        ({"monitor": {"scores": ["smell"]}}, "greeting.monitor"),
        ({"monitor": record.to_json(late(execute=4))}, "greeting.monitor"),  # plans have five
    ],
)
def test_a_greeting_is_checked(change, field):
    with openpi(stay, PLAIN | change) as address, mistakes.of(field):
        serving.connect(address)


@pytest.mark.parametrize(
    ("answer", "field"),
    [
        ({}, "answer.actions"),
        ({"actions": np.zeros((5, 7))}, "answer.actions"),
        ({"actions": np.zeros((5, 8))}, "answer.actions"),
        ("Traceback\nKeyError: 'wrist'", "--policy"),
    ],
)
def test_the_first_plan_is_checked(answer, field):
    with openpi(lambda request: answer, PLAIN) as address, mistakes.of(field):
        serving.connect(address)


def test_no_server():
    with mistakes.of("--policy"):
        serving.connect("ws://127.0.0.1:9")


def test_an_action_is_position_quaternion_and_gripper():
    from starjax.deploy import plain

    spec = Stub.input_spec
    turned = np.float32([[0.1, 0, 0.1, 0, 0, 2 * np.sqrt(0.5), 2 * np.sqrt(0.5), 3.0]])
    task = stubs.make_task()
    plan = plain.decode(spec, "pose", task, {"actions": turned}, served.PORT)
    assert isinstance(plan, Command) and plan.gripper.tolist() == [1.0]
    np.testing.assert_allclose(plan.pose.R[0] @ [1, 0, 0], [0, 1, 0], atol=1e-6)
    rolled = np.float32([[0.3, 0.0, 0.01, 0.03, 1.0]] * 2)
    plan = plain.decode(spec, "rcm4", task, {"actions": rolled}, served.PORT)
    place = rcm.trocar_position(served.PORT, spec.p_world_ref)
    assert np.asarray(rcm.rcm_error(plan.pose, place)).max() < 1e-6
    np.testing.assert_allclose(rcm.roll_of(plan.pose.R), 0.3, atol=1e-6)
    np.testing.assert_allclose(plan.pose.p, rolled[:, 1:4], atol=1e-7)
