"""A simulated robot in a process of its own, with faults by lines on its standard input.

    python robot_process.py DOMAIN [YAW] [ARM INSTRUMENT]

`freeze`, `state NAME`, `trocar X Y Z`, `warn TEXT`, `rival`, `end`; then it prints its commands.
Its clock is its own: it stands while the machine is busy, and waits for the commands that are due.
"""

import json
import queue
import sys
import threading
import time

import numpy as np

from starjax.addons.robots import bus, kinematics, messages, robot_file, sim_arm

PATIENCE_S = 0.05  # the clock waits for a node that commands


def on_shaft(kin: kinematics.Kinematics) -> np.ndarray:
    """A trocar `[3]` m in the base frame, 0.1 m above the tip at home."""
    tip = kin.tip_of(kin.home)
    return np.asarray(tip.p - 0.1 * tip.R[:, 2])


def main(domain: str, yaw: str = "0", kind: str = "psm", tool: str = "large_needle_driver") -> None:
    own = bus.Bus(robot_file.Network(int(domain), "lo"))
    kin = kinematics.of(kind, tool, "peg_transfer")
    q = kin.home + float(yaw) * np.eye(len(kin.home))[0]
    body = sim_arm.Kinematic(kin, np.zeros((32, 32, 3), np.uint8), q)
    if kind != "psm":
        body.p_base_trocar = on_shaft(kin)
    arm = sim_arm.SimArm(own, body, is_clocked=True)
    lines, rivals = queue.SimpleQueue(), []
    threading.Thread(target=lambda: [lines.put(x) for x in sys.stdin], daemon=True).start()
    print("ready", flush=True)
    is_over = False
    while not is_over:
        end = time.monotonic() + PATIENCE_S
        if arm.commands:  # in step with a node, as fast as both can
            while not arm.take() and time.monotonic() < end:
                time.sleep(1e-4)
            arm.step()
        else:
            arm.run(1.0 / sim_arm.RATE)
        while not lines.empty():
            word, *rest = lines.get().split()
            if word == "freeze":
                arm.is_frozen = True
            elif word == "state":
                arm.state = rest[0]
            elif word == "trocar":
                arm.p_trocar = np.array(list(map(float, rest)))
            elif word == "warn":
                arm.warn(" ".join(rest))
            elif word == "rival":
                rivals.append(own.writer("/PSM1/servo_jp", messages.JointState, "servo"))
            is_over |= word == "end"
    told = {"commands": arm.commands, "holds": arm.holds, "moved": arm.moved}
    told |= {"q": body.q.tolist(), "clock": arm.clock}
    print(json.dumps(told), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
