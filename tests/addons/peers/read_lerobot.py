"""Opens an export with LeRobot's own loader; prints its content as JSON. Runs where that is."""

import json
import sys
from pathlib import Path

import torchvision_or_stub  # noqa: F401 (before what needs torchvision)
from lerobot.datasets import lerobot_dataset
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torchvision import io


def decoded(path, timestamps, tolerance_s, backend=None):
    """Frames by PyAV, as later versions of LeRobot decode them."""
    import av
    import torch

    with av.open(str(path)) as file:
        frames = {float(f.pts * f.time_base): f for f in file.decode(video=0)}
    nearest = [min(frames, key=lambda at: abs(at - t)) for t in timestamps]
    assert max(abs(a - b) for a, b in zip(nearest, timestamps)) < tolerance_s
    images = [torch.from_numpy(frames[at].to_ndarray(format="rgb24")) for at in nearest]
    return torch.stack(images).permute(0, 3, 1, 2).float() / 255


if not hasattr(io, "VideoReader"):  # which this version of LeRobot calls, and torchvision dropped
    lerobot_dataset.decode_video_frames = decoded

root = Path(sys.argv[1])
dataset = LeRobotDataset(
    "somebody/demonstrations", root=root, video_backend="pyav", download_videos=False
)
first, last = dataset[0], dataset[len(dataset) - 1]
cameras = dataset.meta.camera_keys
windows = LeRobotDataset(
    "somebody/demonstrations",
    root=root,
    video_backend="pyav",
    download_videos=False,
    delta_timestamps={"observation.state": [-1 / dataset.fps, 0.0], "action": [0.0]},
)
print(
    json.dumps(
        {
            "episodes": dataset.num_episodes,
            "frames": len(dataset),
            "hz": dataset.fps,
            "task": first["task"],
            "state": last["observation.state"].tolist(),
            "action": first["action"].tolist(),
            "before": windows[1]["observation.state"][0].tolist(),
            "images": {name: list(first[name].shape) for name in cameras},
            "mean": {name: float(last[name].mean()) for name in cameras},
            "stats": dataset.meta.stats["action"]["mean"].tolist(),
        }
    )
)
