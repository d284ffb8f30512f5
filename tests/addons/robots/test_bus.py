"""Topics in one process: profiles (QoS) that match or not, states kept for late readers, types."""

import time

import pytest

pytest.importorskip("cyclonedds")

from loopback import DOMAIN

from starjax.addons.robots import bus, messages, robot_file, topic_table
from starjax.addons.robots.messages import Header, StringStamped

NETWORK = robot_file.Network(DOMAIN, "lo")
PROFILES = ("default", "servo", "sensor", "latched")


@pytest.fixture(scope="module")
def pair():
    """Two participants: the first writes, the second reads."""
    return bus.Bus(NETWORK), bus.Bus(NETWORK)


def received(pair, topic, writer, text, seconds):
    """Returns the newest text of a topic that is written again and again; writer None: once."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if writer is not None:
            writer.write(StringStamped(Header(), text))
        pair[1].poll()
        if topic in pair[1].newest:
            return pair[1].newest[topic].string
        time.sleep(0.01)
    return None


@pytest.mark.parametrize("profile", PROFILES)
def test_a_reader_without_promises_matches_every_writer(pair, profile):
    topic = f"/bus/{profile}"
    pair[1].read(topic, StringStamped, "default")
    writer = pair[0].writer(topic, StringStamped, profile)
    assert received(pair, topic, writer, profile, 20.0) == profile


def test_a_kept_state_reaches_a_reader_that_comes_late(pair):
    writer = pair[0].writer("/bus/kept", StringStamped, "latched")
    for text in ("before", "last"):
        writer.write(StringStamped(Header(), text))
    pair[1].read("/bus/kept", StringStamped, "latched")
    assert received(pair, "/bus/kept", None, "", 20.0) == "last"


@pytest.mark.parametrize("profile", ["default", "sensor"])
def test_a_profile_that_keeps_nothing_is_named(pair, profile):
    """A reader of kept states does not match it: the writer is there, no message comes."""
    topic = f"/bus/not_kept/{profile}"
    pair[1].read(topic, StringStamped, "latched")
    writer = pair[0].writer(topic, StringStamped, profile)
    assert received(pair, topic, writer, "lost", 0.5) is None
    found = tuple(pair[1].writers(topic))
    assert found == ("crtk_msgs/msg/StringStamped",)
    row = topic_table.TopicRow(topic, found[0], found, 0.0, None)
    (line,) = topic_table.problems([row._replace(unmatched=pair[1].unmatched(topic))])
    assert ("reliability" if profile == "sensor" else "durability") in line
    pair[1].read("/bus/nobody", StringStamped)
    assert pair[1].unmatched("/bus/nobody") == ""


@pytest.mark.parametrize("is_other", [False, True])
def test_a_type_of_another_version_is_named(pair, monkeypatch, is_other):
    topic, name = f"/bus/version/{is_other}", "crtk_msgs/msg/StringStamped"
    with monkeypatch.context() as changed:
        if is_other:
            changed.setitem(messages.HASHES, name, "0" * 64)
        writer = pair[0].writer(topic, StringStamped)
    pair[1].read(topic, StringStamped)
    assert received(pair, topic, writer, "text", 20.0) == "text"
    (found,) = pair[1].writers(topic)
    row = topic_table.TopicRow(topic, name, (found,), 1.0, 0.0)
    assert len(topic_table.problems([row])) == is_other and found.startswith(name)
