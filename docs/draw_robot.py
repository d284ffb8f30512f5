"""Draws images/FILM.mp4: a policy and a robot in two processes, by what they publish over ROS 2.

    python docs/draw_robot.py robot
    python docs/draw_robot.py OTHER --arm psm --instrument large_needle_driver \\
        --task needle_drive --camera camera_near --policy needle_drive --seconds 30

`starjax sim-robot` is the robot, `starjax robot` its node. This program listens: at the left the
camera's topic, at the right that of rviz's markers from the side: trocar, shaft, plan, path so far.
"""

import argparse
import pathlib
import subprocess
import sys
import tempfile
import time
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw

from starjax.addons.robots import bus, markers, messages, node, robot_file
from starjax.report import encode, video

IMAGES = pathlib.Path(__file__).parent / "images"
DOMAIN = 61  # of DDS; tests have those from 64 on
SIZE = 256  # pixels, side of a picture
SPEED = 2  # times the robot's time
HEIGHT = 0.2  # m, of the view from the side
LOWEST = -0.02  # m
HOLD = 30  # times that the last picture is shown
COLORS = {1: "#e6e9ec", 2: "#f0b429"}  # of lines: shaft, plan
PATH = "#5ab4e8"
STARTS_S = 300.0  # for which a process may compile


class Moment(NamedTuple):
    """The newest messages at one picture.

    Attributes:
      time: s, of the robot's clock. picture: `[SIZE, SIZE, 3]` uint8. shown: markers.
    """

    time: float
    picture: np.ndarray
    shown: markers.MarkerArray


def main() -> None:
    """Runs both processes, and writes the film."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("film")
    for name, value in {
        "arm": "fr5",
        "instrument": "grasper",
        "task": "peg_transfer",
        "camera": "camera",
        "policy": "compact",
    }.items():
        parser.add_argument(f"--{name}", default=value)
    parser.add_argument("--seed", type=int, default=0, help="of the objects' places")
    parser.add_argument("--seconds", type=float, default=11.0, help="of the robot's clock")
    args = parser.parse_args()
    moments, end = record(args)
    print(f"{len(moments)} pictures, {moments[-1].time - moments[0].time:.1f} s, {end}")
    shown = range(SPEED, len(moments) + 1, SPEED)
    frames = [draw(moments[:count]) for count in shown] + [draw(moments, end)] * HOLD
    encode.write(frames, IMAGES / f"{args.film}.mp4", 30.0)


def record(args: argparse.Namespace) -> tuple[list[Moment], str]:
    """Returns the moments from the first marker on, and the robot's last line."""
    command = [sys.executable, "-m", "starjax"]
    with tempfile.TemporaryDirectory() as folder:
        file = pathlib.Path(folder) / "sim.toml"
        flags = [f"--{name}={vars(args)[name]}" for name in ("arm", "instrument", "task", "camera")]
        flags += [f"--seed={args.seed}", f"--image-size={SIZE}", f"--domain={DOMAIN}"]
        simulated = subprocess.Popen(
            [*command, "sim-robot", *flags, f"--file={file}"], stdout=subprocess.PIPE, text=True
        )
        try:
            simulated.stdout.readline()
            run = [f"--policy={args.policy}", "--begin", f"--seconds={args.seconds}"]
            with subprocess.Popen([*command, "robot", str(file), *run]) as driver:
                moments = listen(robot_file.read(file), driver)
            simulated.terminate()
            return moments, simulated.communicate(timeout=60)[0].splitlines()[-1]
        finally:
            simulated.kill()


def listen(file: robot_file.RobotFile, driver: subprocess.Popen) -> list[Moment]:
    """Returns a moment for each message of markers until the node ends."""
    own = bus.Bus(file.network)
    topic, shown = next(iter(file.cameras.values())).topic, f"{node.AT}/markers"
    own.read(topic, messages.Image, "sensor")
    own.read(shown, markers.MarkerArray)
    moments, end = [], time.monotonic() + STARTS_S
    while driver.poll() is None and (moments or time.monotonic() < end):
        fresh = own.poll()
        if shown in fresh and topic in own.newest:
            image = own.newest[topic]
            picture = np.frombuffer(bytes(image.data), np.uint8).reshape(SIZE, SIZE, 3)
            moments.append(Moment(own.now(), picture, own.newest[shown]))
        time.sleep(5e-4)
    return moments


def draw(moments: list[Moment], end: str = "") -> np.ndarray:
    """Draws the last moment `[SIZE + bar, 2 SIZE, 3]`, with the outcome at the end."""
    last, side = moments[-1], Image.new("RGB", (SIZE, SIZE), "#14181c")
    ball, pen = last.shown.markers[0], ImageDraw.Draw(side)

    def pixel(point: messages.Point) -> tuple[float, float]:
        scale = SIZE / HEIGHT
        x = scale * (point.x - ball.pose.position.x)
        return SIZE / 2 + x, SIZE - scale * (point.z - LOWEST)

    pen.line([pixel(one.shown.markers[1].points[-1]) for one in moments], PATH, width=1)
    for one in last.shown.markers:
        if one.points:
            pen.line([pixel(point) for point in one.points], COLORS[one.id], width=3)
    x, y = pixel(ball.pose.position)
    color = tuple(round(255 * part) for part in (ball.color.r, ball.color.g, ball.color.b))
    pen.ellipse([x - 4, y - 4, x + 4, y + 4], color)
    text = "" if end else last.shown.markers[-1].text
    at = end or f"{last.time - moments[0].time:.1f} s"
    rows = [
        [(at, "#e6e9ec"), (text, "#e6e9ec")],
        [("/camera/image_raw", "#98a2ad"), ("/starjax/markers", "#98a2ad")],
    ]
    bar = video.caption(rows, 2 * SIZE)
    return np.concatenate([bar, np.concatenate([last.picture, np.asarray(side)], 1)])


if __name__ == "__main__":
    main()
