"""Serves a checkpoint of LeRobot in openpi's protocol, for `starjax evaluate --policy ws://...`.

    pip install 'lerobot>=0.6' 'starjax[serve,sim]'
    python examples/14_serve_lerobot.py outputs/train/.../pretrained_model --task peg_transfer

Its policy was trained on `starjax export`. What it observes (the trocar as part of the state or
not, which camera, which size) and what it commands (poses or rcm4) is read off its features.
"""

import argparse
import contextlib

import numpy as np
import torch
import websockets
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from websockets.sync import server

from starjax.deploy import wire

STATE, TROCAR, IMAGES = "observation.state", "observation.trocar", "observation.images."
POSE = 8  # numbers of an arm: x y z, quaternion x y z w, gripper


class Served:
    """A checkpoint as a function from requests to answers."""

    def __init__(self, path: str, task: str) -> None:
        config = PreTrainedConfig.from_pretrained(path)
        config.device = "cuda" if torch.cuda.is_available() else "cpu"
        self.policy = get_policy_class(config.type).from_pretrained(path, config=config).eval()
        device = {"device_processor": {"device": config.device}}
        self.before, self.after = make_pre_post_processors(
            config, path, preprocessor_overrides=device
        )
        self.inputs = config.input_features
        images = [name for name in self.inputs if name.startswith(IMAGES)]
        self.camera = images[0] if images else None
        self.metadata = {
            "scene": {"task": task},
            "observation": "image" if images else "state",
            "execute": config.n_action_steps,
        }
        if self.camera:
            self.metadata["image_size"] = self.inputs[self.camera].shape[-1]
        if config.output_features["action"].shape[0] % POSE:
            self.metadata["action_space"] = "rcm4"

    def infer(self, request: dict) -> dict:
        """Plans; one request has the latest observation."""
        state, trocar = (np.array(request[f"observation/{x}"]) for x in ("state", "trocar"))
        if self.inputs[STATE].shape[0] > len(state):
            state = np.concatenate([state, trocar])
        batch = {STATE: torch.from_numpy(state)[None], TROCAR: torch.from_numpy(trocar)[None]}
        if self.camera:
            image = torch.from_numpy(np.array(request["observation/image"]))
            batch[self.camera] = image.permute(2, 0, 1)[None].float() / 255
        else:
            fields = np.array(request["observation/environment_state"])
            batch["observation.environment_state"] = torch.from_numpy(fields)[None]
        with torch.inference_mode():
            plan = self.policy.predict_action_chunk(self.before({**batch, "task": [""]}))
            actions = self.after(plan)[0].cpu().numpy()
        return {"actions": actions.astype(np.float32)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("checkpoint")
    parser.add_argument("--task", default="peg_transfer")
    parser.add_argument("--port", type=int, default=8000)
    args = parser.parse_args()
    served = Served(args.checkpoint, args.task)

    def answer(connection: server.ServerConnection) -> None:
        connection.send(wire.pack(served.metadata))
        with contextlib.suppress(websockets.ConnectionClosed):  # clients may just leave
            for frame in connection:
                connection.send(wire.pack(served.infer(wire.unpack(frame))))

    with server.serve(answer, "127.0.0.1", args.port, compression=None, max_size=None) as running:
        print(f"serving at ws://127.0.0.1:{running.socket.getsockname()[1]}", flush=True)
        running.serve_forever()


if __name__ == "__main__":
    main()
