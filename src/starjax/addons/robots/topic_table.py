"""The topics of a robot as they are found: types, writers, rates, ages."""

import time
from collections.abc import Callable
from typing import NamedTuple

from starjax.addons.robots.arm import CrtkArm


class TopicRow(NamedTuple):
    """A topic that an arm reads, or commands.

    Attributes:
      topic: its name.
      kind: its message, as ROS names it.
      found: types of its writers.
      rate: messages per second.
      age: s since the newest one's stamp, None without one.
      is_command: True for a topic of commands, with no other writer.
      unmatched: promise of the reader that a writer does not make, see `Bus.unmatched`.
    """

    topic: str
    kind: str
    found: tuple[str, ...]
    rate: float
    age: float | None
    is_command: bool = False
    unmatched: str = ""


def look(
    arm: CrtkArm, seconds: float, wait_s: float, should_stop: Callable[[], bool]
) -> list[TopicRow]:
    """Waits for all topics, at most `wait_s`, then counts messages for some seconds."""
    end = time.monotonic() + wait_s
    while arm.missing() and time.monotonic() < end and not should_stop():
        arm.poll()
        time.sleep(0.005)
    counts = dict.fromkeys(arm.sources, 0)
    end = time.monotonic() + seconds
    while time.monotonic() < end and not should_stop():
        fresh = set(arm.poll())
        for name, source in arm.sources.items():
            counts[name] += source.topic in fresh
        time.sleep(0.002)
    now, missing = arm.bus.now(), arm.missing()
    rows = [
        TopicRow(
            source.topic,
            source.name,
            tuple(arm.bus.writers(source.topic)),
            counts[name] / seconds,
            None if name in missing else arm.age(name, now),
            unmatched=arm.bus.unmatched(source.topic),
        )
        for name, source in arm.sources.items()
    ]
    return rows + [
        TopicRow(topic, "", tuple(arm.bus.writers(topic)), 0.0, None, is_command=True)
        for topic in arm.commands
    ]


def problems(rows: list[TopicRow]) -> list[str]:
    """Returns the topics that do not fit, in one line each."""
    out = []
    for row in rows:
        if row.is_command:
            if row.found:
                out.append(f"{row.topic}: {len(row.found)} other programs command the arm")
        elif not row.found:
            out.append(f"{row.topic}: no writer: compare domain, interface and namespace")
        elif set(row.found) != {row.kind}:
            out.append(f"{row.topic}: expected {row.kind}, got {', '.join(sorted(set(row.found)))}")
        elif len(row.found) > 1:
            out.append(f"{row.topic}: {len(row.found)} writers")
        elif row.age is None:
            why = f": its writer has another {row.unmatched} (QoS)" if row.unmatched else ""
            out.append(f"{row.topic}: no message{why}")
    return out


def text(rows: list[TopicRow]) -> str:
    """Returns the table."""
    lines = [("topic", "type", "writers", "Hz", "age s")]
    for row in rows:
        age = "" if row.age is None else f"{row.age:.3f}"
        rate = "" if row.is_command else f"{row.rate:.0f}"
        lines.append((row.topic, row.kind, str(len(row.found)), rate, age))
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip()
        for line in lines
    )
