"""A tool steered by hand, as pure functions: a point of the RCM manifold, moved by increments.

A hand moves roll and tip, the coordinates of action space `rcm4`; the shaft follows from them, so
it passes the trocar whatever the hand does. Nothing here is compiled: a few numbers, 30 times a
second.
"""

from typing import NamedTuple

import numpy as np

from starjax.sim import registries
from starjax.sim.tasks.base import Slot

SPEED = 0.05  # m/s at full deflection of a device
SPIN = 1.5  # rad/s
SMOOTHING_S = 0.1  # takes the steps of keys and a hand's tremor out of what is commanded
ROOM = 0.01  # m about the workspace's tips


class Hand(NamedTuple):
    """One arm's hand.

    Attributes:
      wanted: `[4]` roll (rad) and tip (m, world frame) that the hand has asked for.
      action: `[4]` the same, smoothed: what is commanded.
      gripper: -1 squeezes, +1 is fully open.
    """

    wanted: np.ndarray
    action: np.ndarray
    gripper: float = 1.0


class Bounds(NamedTuple):
    """`low`, `high`: `[4]` of roll (rad) and tip (m)."""

    low: np.ndarray
    high: np.ndarray


def bounds(slot: Slot, tip: np.ndarray) -> Bounds:
    """Range that an arm of this slot reaches, the tip `[3]` m where it starts included."""
    space = registries.workspaces.get(slot.workspace)
    low, high = np.minimum(space.low, tip) - ROOM, np.maximum(space.high, tip) + ROOM
    low[2] = min(space.low[2], tip[2])  # no room below: there is the table
    return Bounds(np.array([space.rolls[0], *low]), np.array([space.rolls[1], *high]))


def resting(action: np.ndarray, gripper: float) -> Hand:
    """A hand that asks for what is there."""
    return Hand(np.array(action), np.array(action), gripper)


def moved(hand: Hand, by: np.ndarray, within: Bounds) -> Hand:
    """The hand after an increment `[4]` (rad, m), kept within bounds."""
    return hand._replace(wanted=np.clip(hand.wanted + by, within.low, within.high))


def turned(hand: Hand) -> Hand:
    """The hand with its jaws the other way."""
    return hand._replace(gripper=-1.0 if hand.gripper > 0 else 1.0)


def smoothed(hand: Hand, period: float) -> Hand:
    """The hand one period (s) later."""
    share = 1.0 - np.exp(-period / SMOOTHING_S)
    return hand._replace(action=hand.action + share * (hand.wanted - hand.action))


def increment(deflection: np.ndarray, axes: np.ndarray, scale: float, period: float) -> np.ndarray:
    """Increment of a period from a device that is held at a deflection.

    Args:
      deflection: `[4]` in [-1, 1]: roll, right, away, up.
      axes: `[3, 3]`, see `axes_seen`.
      scale: of the motion. period: s.

    Returns:
      `[4]` rad and m in the world frame.
    """
    tip = SPEED * (axes @ deflection[1:])
    return scale * period * np.array([SPIN * deflection[0], *tip])


def axes_seen(R_world_cam: np.ndarray) -> np.ndarray:
    """`[3, 3]`, columns right, away and up in the world, for a person who looks at the picture."""
    right = np.array([*R_world_cam[:2, 0], 0.0])
    length = np.linalg.norm(right)
    right = right / length if length > 1e-6 else np.array([0.0, 1.0, 0.0])
    up = np.array([0.0, 0.0, 1.0])
    return np.stack([right, np.cross(up, right), up], axis=1)
