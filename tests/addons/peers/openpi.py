"""openpi's own client talks to `starjax serve`.

    python tests/addons/peers/openpi.py PEER_PYTHON

PEER_PYTHON is a Python with `openpi-client` (and `typing_extensions`, a requirement that it omits);
it needs numpy below 2, so it lives in an environment of its own. Without it nothing is run.
"""

import json
import os
import re
import subprocess
import sys

import numpy as np

KEY = "of a test"
ANGLE = 0.3  # rad, of the tool's roll
TROCAR = [0.0, 0.0, 0.15]  # m, the nominal one


def asked(image_size):
    """A tool straight down through the nominal trocar, 7 cm deep."""
    cos, sin = np.cos(ANGLE), np.sin(ANGLE)
    R = np.array([[cos, sin, 0.0], [sin, -cos, 0.0], [0.0, 0.0, -1.0]])
    rng = np.random.default_rng(0)
    return {
        "R": np.stack([R, R]),
        "p": np.full((2, 3), [0.0, 0.0, 0.08]),
        "gripper": np.ones(2),
        "trocar": np.array(TROCAR),
        "image": rng.integers(0, 256, (2, image_size, image_size, 3), np.uint8),
        "key": np.array([0, 7], np.uint32),
    }


def peer(port):
    """In the peer's Python: prints the answers of its client, as JSON."""
    from openpi_client import action_chunk_broker, websocket_client_policy

    client = websocket_client_policy.WebsocketClientPolicy("127.0.0.1", port, api_key=KEY)
    about = client.get_server_metadata()
    request = asked(about["asks"]["image_size"])
    try:
        client.infer({"prompt": "pick up the block"})  # which alone is no observation
        refused = ""
    except RuntimeError as error:
        refused = str(error).splitlines()[-1]
    plan = client.infer(request | {"prompt": "pick up the block"})
    size = 2 * about["asks"]["image_size"]
    one = {name: x[0] if name in ("R", "p", "gripper") else x for name, x in request.items()}
    one["image"] = np.full((size, size, 3), 0.5, np.float32)
    single = client.infer(one)["actions"].shape
    broker = action_chunk_broker.ActionChunkBroker(client, about["execute"])
    steps = [broker.infer(request)["actions"].tolist() for _ in range(about["execute"] + 1)]
    try:
        websocket_client_policy.WebsocketClientPolicy("127.0.0.1", port, api_key="wrong")
        stranger = "let in"
    except Exception as error:
        stranger = str(error)
    said = {
        "policy": about["policy"],
        "refused": refused,
        "actions": plan["actions"].tolist(),
        "steps": steps,
        "stranger": stranger,
        "single": single,
        "numpy": np.__version__,
    }
    print(json.dumps(said))


def main(python):
    found = subprocess.run([python, "-c", "import openpi_client"], capture_output=True)
    if found.returncode:
        print(f"{python}: openpi-client is not installed there; nothing was run")
        return 0
    environment = {**os.environ, "STARJAX_API_KEY": KEY}
    command = [sys.executable, "-m", "starjax", "serve", "--port", "0", "--batch", "1"]
    server = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)
    try:
        lines = iter(server.stdout.readline, "")
        port = next(found[1] for found in (re.search(r":(\d+),", x) for x in lines) if found)
        run = subprocess.run([python, __file__, "--peer", port], capture_output=True, text=True)
    finally:
        server.terminate()
        server.wait()
    if run.returncode:
        print(run.stderr)
        return 1
    return compare(json.loads(run.stdout.splitlines()[-1]))


def compare(said):
    """Answers of the peer and of a call in this process."""
    import jax

    from starjax import deploy, rcm

    policy = deploy.load("compact")
    given = asked(policy.settings.image_size)
    pose = deploy.Pose(given["R"], given["p"])
    seen = deploy.Observation(pose=pose, gripper=given["gripper"], image=given["image"])
    command = policy(
        jax.numpy.asarray(given["key"]), seen, rcm.trocar_from_position(TROCAR, TROCAR)
    )
    actions = np.array(said["actions"])
    tips = 1e3 * np.abs(actions[:, :3] - np.asarray(command.pose.p)).max()
    steps = np.abs(np.array(said["steps"][:-1]) - actions[: len(said["steps"]) - 1]).max()
    print(f"numpy {said['numpy']}, policy {said['policy']}: actions {list(actions.shape)}")
    print(f"tips differ from the call in this process by at most {tips:.1e} mm")
    print(f"ActionChunkBroker's steps differ from the plan by {steps:.1e}")
    print(f"refused: {said['refused']}")
    print(f"with a wrong key: {said['stranger']}")
    print(f"one moment with a larger image of floats: actions {said['single']}")
    good = tips < 1e-3 and steps < 1e-5 and said["refused"].startswith("R: ")
    good = good and said["single"] == list(actions.shape)
    return 0 if good and "401" in said["stranger"] else 1


if __name__ == "__main__":
    if sys.argv[1:2] == ["--peer"]:
        peer(int(sys.argv[2]))
    elif len(sys.argv) == 2:
        sys.exit(main(sys.argv[1]))
    else:
        sys.exit(__doc__)
