"""Opens an export with robomimic's own dataset; prints its content. Runs where that is."""

import json
import sys

# isort: off
import torchvision_or_stub  # noqa: F401 (before what needs torchvision)
import robomimic.utils.file_utils as files
import robomimic.utils.obs_utils as obs
from robomimic.utils.dataset import SequenceDataset

# isort: on

path = sys.argv[1]
about = files.get_env_metadata_from_dataset(path)
obs.initialize_obs_utils_with_obs_specs(
    {"obs": {"low_dim": ["state", "trocar"], "rgb": ["camera_image"]}}
)
dataset = SequenceDataset(
    hdf5_path=path,
    obs_keys=("state", "trocar", "camera_image"),
    dataset_keys=("actions", "rewards", "dones"),
    frame_stack=2,
    seq_length=4,
    load_next_obs=False,
    filter_by_attribute="train",
)
first, last = dataset[0], dataset[len(dataset) - 1]
print(
    json.dumps(
        {
            "episodes": len(dataset.demos),
            "frames": len(dataset),
            "env": about["env_name"],
            "action": first["actions"][1].tolist(),
            "state": last["obs"]["state"][1].tolist(),
            "image": list(first["obs"]["camera_image"].shape),
            "mean": float(last["obs"]["camera_image"][1].mean()),
        }
    )
)
