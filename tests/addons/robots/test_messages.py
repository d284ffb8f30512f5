"""Bytes of every message are those of ROS 2, by a decoder that is not ours."""

import dataclasses

import numpy as np
import pytest

pytest.importorskip("cyclonedds")
typesys = pytest.importorskip("rosbags.typesys")

from starjax.addons.robots import markers  # noqa: E402
from starjax.addons.robots import messages as m  # noqa: E402

HEADER = m.Header(m.Time(7, 9), "PSM1_base")
POSE = m.PoseMessage(m.Point(1.0, -2.0, 3.0), m.Quaternion(0.1, 0.2, 0.3, 0.4))
FILLED = [
    HEADER,
    m.Float64(0.5),
    m.PoseStamped(HEADER, POSE),
    m.TransformStamped(HEADER, "tip", m.Transform(m.Vector3(1.0, 2.0, 3.0))),
    m.PointStamped(HEADER, m.Point(0.1, 0.2, 0.3)),
    m.Path(HEADER, [m.PoseStamped(HEADER, POSE), m.PoseStamped()]),
    m.JointState(HEADER, ["a", "bcd"], [1.0, 2.0], [], [3.0]),
    m.Image(HEADER, 2, 1, "bgr8", 0, 3, bytes(range(6))),
    m.CompressedImage(HEADER, "jpeg", b"\xff\xd8"),
    m.OperatingState(HEADER, "ENABLED", True, False),
    m.StringStamped(HEADER, "fault"),
    m.ClockMessage(m.Time(5, 6)),
    markers.of(HEADER, np.zeros(3), np.ones(3), np.ones((4, 3)), 0.002, "running"),
]
CRTK = {
    "crtk_msgs/msg/OperatingState": "std_msgs/Header header\nstring state\nbool is_homed\n"
    "bool is_busy\n",
    "crtk_msgs/msg/StringStamped": "std_msgs/Header header\nstring string\n",
}


@pytest.fixture(scope="module")
def store():
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    for name, text in CRTK.items():
        store.register(typesys.get_types_from_msg(text, name))
    return store


@pytest.mark.parametrize("message", FILLED, ids=[m.name_of(type(one)) for one in FILLED])
def test_a_message_is_read_and_written_alike(store, message):
    ours, name = bytes(message.serialize()), m.name_of(type(message))
    assert ours[:4] == b"\x00\x01\x00\x00"  # plain CDR, little endian
    theirs = store.deserialize_cdr(ours, name)
    assert bytes(store.serialize_cdr(theirs, name)) == ours
    assert_equal(message, theirs)


@pytest.mark.parametrize("name", m.HASHES)
def test_hashes_of_types_are_those_of_ros(store, name):
    assert store.hash_rihs01(name) == f"RIHS01_{m.HASHES[name]}"


def test_every_message_that_is_written_has_a_hash():
    kinds = {m.name_of(type(one)) for one in FILLED} - {"std_msgs/msg/Header"}
    assert kinds < m.HASHES.keys()


def assert_equal(ours, theirs):
    if not dataclasses.is_dataclass(ours):
        if isinstance(ours, float):  # some are single on the wire
            assert ours == pytest.approx(float(theirs), rel=1e-7)
            return
        np.testing.assert_array_equal(list(ours) if isinstance(ours, bytes) else ours, theirs)
        return
    for field in dataclasses.fields(ours):
        mine, other = getattr(ours, field.name), getattr(theirs, field.name)
        pairs = zip(mine, other, strict=True) if isinstance(mine, list) else [(mine, other)]
        for pair in pairs:
            assert_equal(*pair)


def test_a_picture_is_bytes():
    """The private class of the binding that makes a picture cost 0.1 ms."""
    picture = np.random.default_rng(0).integers(0, 255, (128, 128, 3), np.uint8)
    sent = m.Image(HEADER, 128, 128, "rgb8", 0, 384, picture.tobytes())
    again = m.Image.deserialize(sent.serialize())
    assert isinstance(again.data, bytes) and bytes(again.data) == picture.tobytes()


def test_times_are_those_of_the_clock():
    assert m.stamp(7.5) == m.Time(7, 500_000_000)
    assert m.stamp().sec > 1.6e9
