"""A policy behind a socket: the same plans, and nothing that a client sends ends it."""

import contextlib
import socket
import threading
import time

import fakes
import jax
import mistakes
import numpy as np
import pytest
import served
import websockets
from scipy.spatial.transform import Rotation
from websockets.sync import client as sockets

from starjax import rcm
from starjax.cli import serve
from starjax.core.errors import UsageError
from starjax.deploy import batching, server, wire
from starjax.runtime import connections
from starjax.sim import registries

FRAMES = 300  # bad ones
PLACE = np.asarray(rcm.trocar_position(served.PORT, fakes.P_WORLD_REF[0]))  # m


@pytest.fixture(autouse=True, scope="module")
def registered():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(registries, "tasks", registries.Registry("task", {"fake": "fakes:TASK"}))
        yield


@pytest.fixture(scope="module")
def batches(tmp_path_factory):
    made = batching.Batches(served.policy(tmp_path_factory.mktemp("serve")), max_robots=3)
    made.warm_up()
    return made


@pytest.fixture(scope="module")
def up(batches):
    with served.running(batches) as found:
        yield found


def connect(where, key=served.KEY, **options):
    headers = {"Authorization": f"Api-Key {key}"} if key else {}
    address = f"ws://{where[0]}:{where[1]}"
    return sockets.connect(address, additional_headers=headers, compression=None, **options)


def asked(batches, seed=0, height=0.03):
    key = np.asarray(jax.random.key_data(jax.random.key(seed)))
    seen = served.observation(height)
    return wire.encode_request(batches.policy.input_spec, seen, served.PORT, key)


def infer(connection, value):
    connection.send(wire.pack(value))
    answer = connection.recv(timeout=60)
    return answer if isinstance(answer, str) else wire.unpack(answer)


def test_it_answers_what_the_policy_plans(batches, up):
    policy, where = batches.policy, up[0]
    wanted = policy(jax.random.key(4), served.observation(), rcm.Trocar(*served.PORT))
    with connect(where) as connection:
        about = wire.unpack(connection.recv())
        answer = infer(connection, asked(batches, seed=4))
    for name, value in (("R", wanted.pose.R), ("p", wanted.pose.p), ("gripper", wanted.gripper)):
        np.testing.assert_allclose(answer[name], value, atol=1e-6)
    assert answer["actions"].shape == (16, len(about["actions"]))
    np.testing.assert_array_equal(answer["actions"][:, :3], answer["p"])
    np.testing.assert_array_equal(answer["actions"][:, -1], answer["gripper"])
    assert about["digest"] == policy.digest and about["policy"] == "tiny"
    xyzw = Rotation.from_matrix(answer["R"]).as_quat()
    np.testing.assert_allclose(answer["actions"][:, 3:7], xyzw, atol=1e-6)
    request = asked(batches) | {"trocar": PLACE}
    for name, said in about["inputs"].items():
        array = request[name]
        assert list(array.shape) == said["shape"] and array.dtype == said["dtype"], name


def test_clients_that_share_a_call_get_their_own_plans_and_mistakes(batches):
    requests = [
        wire.decode_request(batches.policy.input_spec, asked(batches, seed, 0.02 + 0.01 * seed))
        for seed in range(3)
    ]
    alone = [batches.infer([request])[0] for request in requests]
    tip = requests[1].observation.pose._replace(p=np.full((2, 3), 9.0, np.float32))
    far = requests[1]._replace(observation=requests[1].observation.replace(pose=tip))
    no_port = requests[1]._replace(trocar=rcm.Trocar(*np.float32([-1.0, 0.0, 0.0])))
    programs = batches.policy._infer._function._cache_size()
    for bad, argument in ((far, "observation.pose.p"), (no_port, "trocar")):
        first, wrong, last = batches.infer([requests[0], bad, requests[2]])
        assert isinstance(wrong, UsageError) and wrong.argument == argument
        for got, wanted in ((first, alone[0]), (last, alone[2])):
            np.testing.assert_allclose(got["p"], wanted["p"], atol=1e-5)
    together = batches.infer(requests)
    for got, wanted in zip(together, alone):
        np.testing.assert_allclose(got["actions"], wanted["actions"], atol=1e-4)
    assert np.abs(alone[0]["p"] - alone[1]["p"]).max() > 1e-3
    # With 1, 2 and 3 robots, all of them compiled before.
    assert batches.sizes == [1, 2, 3] and programs == batches.policy._infer._function._cache_size()


def test_a_trocar_is_a_position_in_the_world(batches, up):
    request = asked(batches)
    wanted = batches.infer([wire.decode_request(batches.policy.input_spec, request)])[0]["p"]
    parameters = request.pop(wire.SPHERICAL)
    with connect(up[0]) as connection:
        connection.recv()
        plan = infer(connection, request | {"trocar": PLACE})["p"]
        np.testing.assert_allclose(plan, wanted, atol=1e-5)
        both = {"trocar": PLACE, wire.SPHERICAL: parameters}
        high = {"trocar": PLACE + np.float32([0, 0, 0.05])}
        for wrong in ({"trocar": parameters}, high, {}, both, {"trocar": PLACE * np.nan}):
            answer = infer(connection, request | wrong)
            assert answer.startswith("trocar: ") and "\n" not in answer
        steep = infer(connection, request | {wire.SPHERICAL: np.float32([0.04, 0.014, 0.15])})
        assert steep.startswith("trocar: ")


def test_a_request_without_a_key_gets_another_noise_each_time(batches, up):
    request = asked(batches)
    del request["key"]
    with connect(up[0]) as connection:
        connection.recv()
        plans = [infer(connection, request)["p"] for _ in range(2)]
    assert np.abs(plans[0] - plans[1]).max() > 1e-5


def test_several_clients_at_once(batches, up):
    where, counts = up
    calls, plans = counts.calls, {}

    def work(seed):
        with connect(where) as connection:
            connection.recv()
            plans[seed] = [infer(connection, asked(batches, seed))["p"] for _ in range(5)]

    threads = [threading.Thread(target=work, args=(seed,)) for seed in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for seed in range(6):
        request = wire.decode_request(batches.policy.input_spec, asked(batches, seed))
        wanted = batches.infer([request])[0]["p"]
        for plan in plans[seed]:
            np.testing.assert_allclose(plan, wanted, atol=1e-5)
    assert counts.calls - calls <= 30


@pytest.mark.parametrize("key", ["", "wrong", "é", served.KEY[:-1]])
def test_a_client_without_the_key_is_not_let_in(up, key):
    with pytest.raises(websockets.InvalidStatus) as caught:
        connect(up[0], key.encode().decode("latin1"))
    assert caught.value.response.status_code == 401


def test_a_page_in_a_browser_is_not_let_in(up):
    with pytest.raises(websockets.InvalidStatus) as caught:
        connect(up[0], origin="http://localhost")
    assert caught.value.response.status_code == 403


def test_more_clients_than_it_may_have_are_sent_away(batches):
    with served.running(batches, clients=1) as (where, _), connect(where) as connection:
        connection.recv()
        with pytest.raises(websockets.InvalidStatus) as caught:
            connect(where)
        assert caught.value.response.status_code == 503


def test_unfinished_handshakes_count_and_time_out(batches, monkeypatch):
    monkeypatch.setattr(connections, "HANDSHAKE_S", 1.0)
    with served.running(batches, clients=1) as (where, _), contextlib.ExitStack() as stack:
        half = [stack.enter_context(socket.create_connection(where, 5)) for _ in range(40)]
        time.sleep(0.3)
        with pytest.raises((OSError, websockets.WebSocketException)):
            connect(where)
        time.sleep(1.2)
        with connect(where) as connection:
            connection.recv()
        for connection in half:
            connection.settimeout(5)
            with contextlib.suppress(ConnectionResetError):
                assert connection.recv(1) == b""


def test_no_frame_ends_it(batches, up):
    where, counts = up
    rng, good = np.random.default_rng(0), wire.pack(asked(batches))
    answers, connection = [], connect(where)
    connection.recv()
    for _ in range(FRAMES):
        connection.send(served.bad_frame(rng, good))
        answers.append(connection.recv(timeout=60))
    refused = sum(isinstance(answer, str) for answer in answers)
    assert refused > 0.8 * FRAMES and all("Traceback" not in str(answer) for answer in answers)
    assert isinstance(infer(connection, asked(batches)), dict)  # on the same connection
    with pytest.raises(websockets.ConnectionClosed):
        connection.send(bytes(wire.max_request_bytes(batches.policy.input_spec) + 1))
        connection.recv(timeout=60)
    with connect(where) as other:
        other.recv()
        assert isinstance(infer(other, asked(batches)), dict)
    assert counts.refused >= refused


def test_a_fault_of_the_device_is_told_and_passes(batches, up, monkeypatch):
    with connect(up[0]) as connection, monkeypatch.context() as patch:
        connection.recv()

        def broken(*given):
            raise RuntimeError("out of memory")

        patch.setattr(batches, "infer", broken)
        assert "out of memory" in infer(connection, asked(batches))
        patch.undo()
        assert isinstance(infer(connection, asked(batches)), dict)


def test_it_ends_while_it_decides(batches, monkeypatch):
    begun, decide = threading.Event(), batches.infer

    def slowly(requests):
        begun.set()
        time.sleep(0.5)
        return decide(requests)

    monkeypatch.setattr(batches, "infer", slowly)
    with served.running(batches) as (where, counts):
        connections = [connect(where) for _ in range(4)]  # one more than a call takes
        for connection in connections:
            connection.recv()
            connection.send(wire.pack(asked(batches)))
        assert begun.wait(60)
    assert counts.answered >= 1
    for connection in connections:
        connection.close()


def test_a_port_that_is_taken_is_one_line(batches, up):
    with pytest.raises(UsageError) as caught:
        server.run(batches.policy, server.ServerSettings(port=up[0][1]))
    assert caught.value.argument == "--port"


@pytest.mark.parametrize(
    ("argv", "argument"),
    [
        (["--host", "0.0.0.0"], "STARJAX_API_KEY"),
        (["--policy", "nowhere"], "--policy"),
        (["--port", "70000"], "port"),
    ],
)
def test_a_mistake_waits_for_nothing(argv, argument, monkeypatch):
    monkeypatch.delenv("STARJAX_API_KEY", raising=False)
    with pytest.raises(UsageError) as caught:
        serve.main(argv)
    assert caught.value.argument.lstrip("-") == argument.lstrip("-")


def test_a_damaged_policy_is_one_line(tmp_path):
    (tmp_path / "policy.safetensors").write_bytes(b"x")
    with mistakes.of("--policy", "policy.safetensors"):
        serve.main(["--port", "0", "--policy", str(tmp_path / "policy.safetensors")])


def test_its_own_machine_needs_no_key():
    here = {"127.0.0.1": True, "localhost": True, "::1": True, "0.0.0.0": False, "robot": False}
    assert {host: serve._is_local(host) for host in here} == here


def test_the_largest_frame_holds_every_request():
    spec = fake_spec()
    request = wire.encode_request(
        spec,
        served.observation().replace(images={n: np.zeros((2, 48, 48, 3), np.uint8) for n in "ab"}),
        served.PORT,
        np.zeros(2),
    )
    doubled = {k: v if v.dtype == np.uint8 else v.astype(np.float64) for k, v in request.items()}
    doubled["key"] = request["key"]
    frame = wire.pack(doubled)
    assert len(frame) <= wire.max_request_bytes(spec)
    again = wire.decode_request(spec, wire.unpack(frame))
    assert set(again.observation.images) == {"a", "b"} and again.observation.state is None


def fake_spec():
    return server.wire.InputSpec(2, (), fakes.P_WORLD_REF[0], True, 48, ("a", "b"), 12)


def test_a_client_has_lines_in_the_log_and_may_send_one_moment(batches):
    lines, one = [], asked(batches) | {"prompt": "reach"}
    with served.running(batches, log=lines.append) as (where, counts):
        with connect(where) as connection:
            connection.recv()
            both = infer(connection, one)["p"]
            single = {n: x[0] if n in ("R", "p", "gripper", "state") else x for n, x in one.items()}
            np.testing.assert_allclose(infer(connection, single)["p"], both, atol=1e-5)
            for _ in range(3):
                infer(connection, single | {"p": np.full(3, 9.0)})
            np.testing.assert_allclose(infer(connection, single)["p"], both, atol=1e-5)
        with pytest.raises(websockets.InvalidStatus):
            connect(where, key="wrong")
        deadline = time.monotonic() + 10
        while len(lines) < 4 and time.monotonic() < deadline:
            time.sleep(0.02)
    assert counts.answered == 3 and counts.refused == 3
    _, refused, left, _ = sorted(lines, key=lambda line: "key" in line)
    assert "observation.pose.p" in refused and "3 answered, 3 refused" in left


def test_a_port_in_use_is_noticed_before_anything_slow(up, monkeypatch):
    monkeypatch.setattr(serve.jax_start, "require_devices", lambda *_: pytest.fail("too late"))
    with pytest.raises(UsageError) as caught:
        serve.main(["--port", str(up[0][1])])
    assert caught.value.argument == "--port"
