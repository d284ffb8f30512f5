"""A simulated robot in a process of its own, with faults by lines on its standard input.

    python robot_process.py DOMAIN [YAW]

`freeze`, `thaw`, `state NAME`, `trocar X Y Z`, `rival`, `end`; then it prints its commands.
"""

import json
import queue
import sys
import threading

import numpy as np

from starjax.addons.robots import bus, messages, robot_file, sim_arm


def main(domain: str, yaw: str = "0") -> None:
    own = bus.Bus(robot_file.Network(int(domain), "lo"))
    q = sim_arm.HOME + float(yaw) * np.eye(6)[0]
    arm = sim_arm.SimArm(own, image=np.zeros((32, 32, 3), np.uint8), q=q)
    lines, rivals = queue.SimpleQueue(), []
    threading.Thread(target=lambda: [lines.put(x) for x in sys.stdin], daemon=True).start()
    print("ready", flush=True)
    is_over = False
    while not is_over:
        arm.run(0.02)
        while not lines.empty():
            word, *rest = lines.get().split()
            if word in ("freeze", "thaw"):
                arm.is_frozen = word == "freeze"
            elif word == "state":
                arm.state = rest[0]
            elif word == "trocar":
                arm.p_trocar = np.array(list(map(float, rest)))
            elif word == "rival":
                rivals.append(own.writer("/PSM1/servo_jp", messages.JointState, "servo"))
            is_over |= word == "end"
    print(
        json.dumps({"commands": arm.commands, "moved": arm.moved, "q": arm.q.tolist()}), flush=True
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
