"""Topics of ROS 2 over DDS: newest messages, other writers, time. Polled, without listeners."""

import functools
import os
import re
import time
from typing import Any
from xml.sax.saxutils import quoteattr

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.internal import InvalidSample
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from starjax.addons.robots import messages
from starjax.addons.robots.messages import ros_name
from starjax.addons.robots.robot_file import Network

_BLOCKING = duration(milliseconds=20)  # wait of a reliable writer for a full reader
_DEPTHS = {"default": 10, "servo": 1, "sensor": 5, "latched": 1}
_URI = "CYCLONEDDS_URI"  # a user's own configuration replaces ours
_HASH = re.compile(rb"typehash=RIHS01_(\w+);")  # in a writer's user data, since ROS 2 Iron
# Promises of a reader that a writer may not make, by DDS's numbers.
_PROMISES = {2: "durability", 11: "reliability"}
_AT_ONCE = 20  # messages of a topic that a poll reads
_CLOCK = "/clock"
# s for which a simulator's clock may stand, as a slow one does. Then it follows the computer's, so
# a dead one's measurements become old.
_PATIENCE_S = 2.0


class Bus:
    """A participant of DDS with its readers and writers.

    Attributes:
      newest: topic -> the newest message. came: topic -> s, `now()` at its arrival.
    """

    def __init__(self, network: Network) -> None:
        self._domain = None if _URI in os.environ else _configured(network.domain, _xml(network))
        self._participant = DomainParticipant(network.domain)
        self._found = BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication)
        self._others: dict[Any, tuple[str, str]] = {}  # key -> topic and type of another's writer
        self._readers: dict[str, DataReader] = {}
        self.newest: dict[str, Any] = {}
        self.came: dict[str, float] = {}
        self._is_simulated, self._ticked = network.use_sim_time, time.monotonic()
        if self._is_simulated:
            self.read(_CLOCK, messages.ClockMessage, "sensor")

    def now(self) -> float:
        """Returns s of the computer's clock, or of the simulator's."""
        if not self._is_simulated:
            return time.time()
        self._take(_CLOCK)
        clock = self.newest.get(_CLOCK, messages.ClockMessage()).clock
        stood = time.monotonic() - self._ticked
        return clock.sec + 1e-9 * clock.nanosec + max(0.0, stood - _PATIENCE_S)

    def wait(self, until: float) -> None:
        """Waits until `now()` is `until`."""
        while (rest := until - self.now()) > 0.0:
            time.sleep(min(rest, 5e-4) if self._is_simulated else rest)

    def read(self, topic: str, kind: type, profile: str = "default") -> None:
        """Subscribes; `poll` keeps the newest message."""
        where = Topic(self._participant, f"rt{topic}", kind)
        # A reader without promises matches every writer; kept states need both to keep them.
        quality = _quality("latched" if profile == "latched" else "sensor", depth=1)
        self._readers[topic] = DataReader(self._participant, where, qos=quality)

    def writer(self, topic: str, kind: type, profile: str = "default") -> DataWriter:
        """Opens a writer of a profile: default, servo, sensor or latched."""
        where = Topic(self._participant, f"rt{topic}", kind)
        about = Qos(Policy.Userdata(f"typehash={messages.type_hash(kind)};".encode()))
        quality = _quality(profile, _DEPTHS[profile])
        return DataWriter(self._participant, where, qos=quality + about)

    def poll(self) -> list[str]:
        """Reads all topics; returns those with a new message."""
        fresh = []
        for topic in self._readers:
            if self._take(topic):
                fresh.append(topic)
        for one in self._found.take(100):
            if not one.sample_info.valid_data:
                self._others.pop(one.key, None)
            elif one.participant_key != self._participant.guid:
                name, found = ros_name(one.type_name), one.qos[Policy.Userdata]
                told = _HASH.search(found.data) if found else None
                if told and told[1].decode() != messages.HASHES.get(name, told[1].decode()):
                    name += " of another version"
                self._others[one.key] = (one.topic_name.removeprefix("rt"), name)
        return fresh

    def _take(self, topic: str) -> bool:
        """Keeps the newest message of a topic; returns False without a new one."""
        # A writer that ended leaves a sample without fields.
        taken = self._readers[topic].take(_AT_ONCE)
        some = [one for one in taken if not isinstance(one, InvalidSample)]
        if some:
            self.newest[topic] = some[-1]
            if topic == _CLOCK:
                self._ticked = time.monotonic()
            else:
                self.came[topic] = self.now()
        return bool(some)

    def writers(self, topic: str) -> list[str]:
        """Returns the types of other participants' writers on a topic, as ROS names them.

        A killed writer counts for another 10 s, the time after which DDS gives a participant up.
        """
        return [kind for where, kind in self._others.values() if where == topic]

    def unmatched(self, topic: str) -> str:
        """Returns the promise of a reader that a writer does not make; empty if all match."""
        status = self._readers[topic].get_requested_incompatible_qos_status()
        return _PROMISES.get(status.last_policy_id, "profile") if status.total_count else ""

    def topics(self) -> list[str]:
        """Returns the topics of other participants' writers."""
        return sorted({where for where, _ in self._others.values()})


@functools.cache
def _configured(domain: int, xml: str) -> Domain:
    """Returns the domain of this process, which has one for all its participants."""
    return Domain(domain, xml)


def _xml(network: Network) -> str:
    """Returns the configuration of Cyclone DDS."""
    peers = ["127.0.0.1"] if network.interface == "lo" else list(network.peers)
    general = discovery = ""
    if network.interface:
        name = quoteattr(network.interface)
        general = f"<Interfaces><NetworkInterface name={name}/></Interfaces>"
    if peers:
        general += "<AllowMulticast>false</AllowMulticast>"
        listed = "".join(f"<Peer address={quoteattr(peer)}/>" for peer in peers)
        discovery = (
            f"<Peers>{listed}</Peers><ParticipantIndex>auto</ParticipantIndex>"
            "<MaxAutoParticipantIndex>30</MaxAutoParticipantIndex>"
        )
    return (
        f"<CycloneDDS><Domain><General>{general}</General><Discovery>{discovery}</Discovery>"
        "<Internal><SocketReceiveBufferSize max='4MB'/></Internal></Domain></CycloneDDS>"
    )


def _quality(profile: str, depth: int) -> Qos:
    is_best_effort = profile == "sensor"
    return Qos(
        Policy.Reliability.BestEffort if is_best_effort else Policy.Reliability.Reliable(_BLOCKING),
        Policy.History.KeepLast(depth),
        Policy.Durability.TransientLocal if profile == "latched" else Policy.Durability.Volatile,
        Policy.DataRepresentation(use_cdrv0_representation=True),
    )
