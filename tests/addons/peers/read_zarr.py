"""Opens an export with the calls of Diffusion Policy's replay buffer, in zarr 2; prints JSON.

The buffer is no package: `copy_from_path` and `get_episode` are these calls of zarr's.
"""

import json
import sys

import zarr

assert zarr.__version__ < "3"
root = zarr.open(sys.argv[1], "r")
store = zarr.MemoryStore()
copied, skipped, size = zarr.copy_store(
    source=root.store, dest=store, source_path="/data", dest_path="/data", if_exists="replace"
)
copy = zarr.group(store=store)
ends = root["meta"]["episode_ends"][:]
last = slice(int(ends[-2]), int(ends[-1]))
print(
    json.dumps(
        {
            "episodes": len(ends),
            "frames": int(ends[-1]),
            "action": copy["data"]["action"][0].tolist(),
            "state": copy["data"]["state"][last][-1].tolist(),
            "image": list(copy["data"]["image_camera"].shape),
            "mean": float(copy["data"]["image_camera"][last][-1].mean()),
            "compressor": copy["data"]["action"].compressor.cname,
        }
    )
)
