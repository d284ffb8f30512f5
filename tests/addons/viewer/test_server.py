"""The page's server and its handles, without a client."""

import contextlib
import gzip
import http.client
import pathlib
import socket
import urllib.request

import numpy as np
import pytest

from starjax import rcm
from starjax.addons.viewer import handles, own_pages, success_map, trocar_controls
from starjax.addons.viewer import page as pages
from starjax.core import errors
from starjax.evaluation import result
from starjax.runtime import connections
from starjax.sim import registries

ROOT = pathlib.Path(__file__).parents[3]


@pytest.fixture(scope="module")
def page():
    with pages.serve(pages.ANY) as server:
        yield server


def test_only_this_machine_is_served(page):
    assert page.get_host() == "127.0.0.1" and pages.address(page).startswith("http://127.0.0.1:")
    with socket.create_connection(("127.0.0.1", page.get_port()), timeout=5):
        pass


def test_a_second_viewer_on_the_port_is_a_mistake_and_leaves_the_first(page):
    with pytest.raises(errors.UsageError) as raised, pages.serve(page.get_port()):
        pass
    assert raised.value.argument == "port" and raised.value.got == page.get_port()
    with socket.create_connection(("127.0.0.1", page.get_port()), timeout=5):
        pass


def test_a_closed_page_gives_its_port_back():
    with pages.serve(pages.ANY) as server:
        port = server.get_port()
    with pages.serve(port) as server:
        assert server.get_port() == port


def test_a_dragged_trocar_stays_where_the_arms_reach(page):
    task = registries.tasks.get("peg_transfer")
    found = handles.TrocarHandles(page.scene, task)
    found.place(np.array([[0.02, 0.0, 0.15]]))
    (handle,) = found._handles
    handle.position = (0.3, 0.0, 0.15)  # as the page's message does
    np.testing.assert_allclose(found.target(), [[0.05, 0.0, 0.15]], atol=1e-6)
    handle.position = (0.01, 0.02, 0.152)
    np.testing.assert_allclose(found.target(), [[0.01, 0.02, 0.152]], atol=1e-6)
    found.remove()


@pytest.mark.parametrize("name", ["peg_transfer", "peg_transfer_bimanual"])
def test_sliders_and_handles_of_trocars_follow_each_other(page, name):
    task = registries.tasks.get(name)
    found = trocar_controls.TrocarControls(page, task)
    start = rcm.Trocar(*(np.asarray(field)[8] for field in task.trocars))
    ref = np.array([slot.p_world_ref for slot in task.slots])
    found.place(np.asarray(rcm.trocar_position(start, ref)))
    assert found.own() is None
    for arm, rows in enumerate(found._sliders):
        rows[0].value, rows[1].value = 20.0 + arm, 100.0
    found._requests.add("slide")
    p = found.target()
    np.testing.assert_allclose(
        np.linalg.norm(p - ref, axis=-1), 0.02 + 0.001 * np.arange(task.arms)
    )
    own = found.own()
    assert own is not None
    np.testing.assert_allclose(own.polar, np.radians(100.0), rtol=1e-5)
    found._requests.add("random")
    drawn = found.target()
    assert np.abs(drawn - p).max() > 1e-4
    for slot, one in zip(task.slots, drawn):
        np.testing.assert_allclose(handles.within(slot, one), one, atol=1e-5)
    # Sliders are at the trocar, for any turn of its azimuth.
    for azimuth in (-10.0, 0.0, 10.0, 350.0):
        angle = np.full(task.arms, np.radians(azimuth))
        wide = rcm.Trocar(np.full(task.arms, 0.03), np.full(task.arms, 1.5), angle)
        p = np.asarray(rcm.trocar_position(wide, ref))
        p = np.stack([handles.within(slot, one) for slot, one in zip(task.slots, p)])
        found.place(p)
        values = np.array([[row.value for row in rows] for rows in found._sliders])
        shown = rcm.Trocar(*(values / [1e3, *[180 / np.pi] * 2]).T)
        np.testing.assert_allclose(rcm.trocar_position(shown, ref), p, atol=1e-3)
    found.release()
    assert found.own() is None
    found.remove()


def test_a_sweep_is_dots_at_its_trocars(page):
    sweep = ROOT / "experiments/packaged_policies/scores/sweep.json"
    found = success_map.read(sweep)
    rate = result.read_sweep(sweep).figures["strict"]
    assert (found.success.sum(), len(found.success)) == (rate["successes"], rate["trials"])
    (slot,) = registries.tasks.get(found.task).slots
    for (one,) in found.p_world_trocar[:20]:
        np.testing.assert_allclose(handles.within(slot, one), one, atol=1e-5)
    dots, floor = success_map.add(page.scene, found)
    assert len(dots.points) == len(found.success)
    assert floor.position[2] > 0.0
    dots.remove()
    floor.remove()


def test_the_floor_of_a_sweep_is_the_rate_nearby():
    """Failures at positive x and y, successes elsewhere: orange in that corner, teal in others."""
    x, y = np.meshgrid(*2 * [np.linspace(-0.03, 0.03, 13)])
    p = np.stack([x.ravel(), y.ravel(), np.full(x.size, 0.15)], -1)[:, None]
    has_failed = (p[:, 0, :2] > 0).all(-1)
    image, bounds = success_map.floor(success_map.SuccessMap("reach", p, ~has_failed))

    def at(place):
        column, row = ((place - bounds[0]) / (bounds[1] - bounds[0]) * image.shape[1::-1]).astype(
            int
        )
        return image[row, column].astype(int)

    failed, *kept = (at(np.array(xy)) for xy in [(0.02, 0.02), (-0.02, 0.02), (0.02, -0.02)])
    assert failed[0] > failed[2] and failed[3] > 200
    for pixel in kept:
        assert pixel[1] > pixel[0] and 60 < pixel[3] < 100
    assert image[0, 0, 3] < 20  # far from all trials
    assert abs(bounds + bounds[::-1]).max() < 1e-9


def test_pictures_are_enlarged_without_blocks():
    image = np.arange(64, dtype=np.uint8)[None, :, None].repeat(64, 0).repeat(3, 2)
    large = pages.enlarged(image, 256)
    assert large.shape == (256, 256, 3) and large.dtype == np.uint8
    assert (np.diff(large[0, :, 0].astype(int)) >= 0).all() and large[0, -1, 0] == 63
    assert pages.enlarged(image, 32) is image


@pytest.mark.parametrize("name", ["peg_transfer", "peg_transfer_bimanual"])
def test_within_is_a_projection_onto_the_workspace(name):
    random = np.random.default_rng(0)
    for slot in registries.tasks.get(name).slots:
        space = registries.workspaces.get(slot.workspace)
        for p in random.normal(scale=0.1, size=(20, 3)) + slot.p_world_ref:
            found = handles.within(slot, p)
            offset = found - np.array(slot.p_world_ref)
            radius = np.linalg.norm(offset)
            assert space.radius[0] - 1e-6 <= radius <= space.radius[1] + 1e-6
            polar = np.arccos(offset[2] / max(radius, 1e-9))
            assert radius < 1e-6 or space.polar[0] - 1e-3 <= polar <= space.polar[1] + 1e-3
            np.testing.assert_allclose(handles.within(slot, found), found, atol=1e-6)


def handshake(page, **headers):
    """The status of a websocket handshake with the page's server."""
    lines = {
        "Host": f"127.0.0.1:{page.get_port()}",
        "Upgrade": "websocket",
        "Connection": "Upgrade",
        "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
        "Sec-WebSocket-Version": "13",
        **headers,
    }
    text = "".join(f"{name}: {value}\r\n" for name, value in lines.items())
    with socket.create_connection(("127.0.0.1", page.get_port()), timeout=5) as connection:
        connection.sendall(f"GET / HTTP/1.1\r\n{text}\r\n".encode())
        return int(connection.recv(100).split()[1])


def test_a_page_of_another_origin_is_refused(page):
    port = page.get_port()
    own, mapped = f"http://127.0.0.1:{port}", "localhost:9000"  # as through a forwarded port
    assert handshake(page) == handshake(page, Origin=own) == 101
    assert handshake(page, Host=mapped, Origin=f"http://{mapped}") == 101
    for origin in ("http://www.w3.org", f"http://127.0.0.1:{port + 1}", "null", ""):
        assert handshake(page, Origin=origin) == 403, origin
    rebound = f"www.w3.org:{port}"
    assert handshake(page, Host=rebound, Origin=f"http://{rebound}") == 403


def test_unfinished_handshakes_are_dropped(page):
    most = own_pages.MAX_PAGES
    with contextlib.ExitStack() as stack:
        half = [
            stack.enter_context(socket.create_connection(("127.0.0.1", page.get_port()), 5))
            for _ in range(2 * most)
        ]
        half[-1].settimeout(connections.HANDSHAKE_S / 2)  # at once, not after it
        with contextlib.suppress(ConnectionResetError):
            assert half[-1].recv(1) == b""


def asked(port, host, origin="", tries=3):
    """Status and text of a request for the page; the server resets some that it refuses."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    connection.putrequest("GET", "/", skip_host=True)
    connection.putheader("Host", host)
    if origin:
        connection.putheader("Origin", origin)
    connection.endheaders()
    try:
        response = connection.getresponse()
        return response.status, response.read().decode(errors="replace")
    except ConnectionError:
        if tries == 1:
            raise
        return asked(port, host, origin, tries - 1)


@pytest.mark.parametrize(
    ("host", "origin"),
    [
        ("lab.example.org", ""),
        ("lab.example.org", "https://lab.example.org"),
        ("localhost:8080", "https://LAB.example.org"),  # a proxy that sends its own Host
        ("127.0.0.1", "http://lab.example.org:8443"),
    ],
)
def test_a_name_is_admitted_by_the_option_alone(page, host, origin):
    status, text = asked(page.get_port(), host, origin)
    assert status == 403 and "--allow-host lab.example.org" in text
    with pages.serve(pages.ANY, names=("Lab.example.org",)) as server:
        assert asked(server.get_port(), host, origin)[0] == 200
        for other in ("evil.example.org", "lab.example.org.evil.org", "xlab.example.org"):
            assert asked(server.get_port(), other)[0] == 403
            assert asked(server.get_port(), "localhost", f"https://{other}")[0] == 403


@pytest.mark.parametrize("encoding", ["identity", "gzip"])
def test_the_page_has_our_title_and_the_systems_colours(page, encoding):
    request = urllib.request.Request(pages.address(page), headers={"Accept-Encoding": encoding})
    with urllib.request.urlopen(request, timeout=30) as response:
        body = response.read()
        assert len(body) == int(response.headers["Content-Length"])
    text = (gzip.decompress(body) if encoding == "gzip" else body).decode()
    assert text.count("<title>") == 1 and "<title>starjax</title>" in text
    assert "prefers-color-scheme: dark" in text.partition("data-p=")[0]
