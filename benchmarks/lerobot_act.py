r"""No time: trains LeRobot's ACT on an export of states, for a row of the trocar benchmark.

    pip install 'lerobot>=0.6'
    starjax collect --preset cpu --task reach --policy.observation state \
        --demos.per-trocar 100 --out runs/reach
    starjax export runs/reach/demos-DIGEST export --state-with-trocar --actions rcm4 --image-size 0
    python benchmarks/lerobot_act.py export checkpoint
    python examples/14_serve_lerobot.py checkpoint --task reach
    starjax evaluate --policy ws://127.0.0.1:8000 --benchmark --no-video

Policy, normalisation and optimiser are LeRobot's. Its loader reads rows one by one, which takes a
second per step on two cores: here the columns are in memory.
"""

import argparse
import pathlib
import time

import numpy as np
import torch
from lerobot.configs.types import NormalizationMode
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors
from lerobot.utils.feature_utils import dataset_to_policy_features

INPUTS = ("observation.state", "observation.environment_state")
CHUNK, EXECUTED, BATCH = 16, 8, 64  # commands planned, executed; windows per step
LARGEST_GRADIENT, LOG_EVERY = 10.0, 200


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("export", type=pathlib.Path)
    parser.add_argument("checkpoint", type=pathlib.Path)
    parser.add_argument("--steps", type=int, default=30_000)
    args = parser.parse_args()
    torch.manual_seed(0)
    torch.set_num_threads(1)
    data = LeRobotDataset("me/demos", root=args.export)
    features = dataset_to_policy_features(data.meta.features)
    config = ACTConfig(
        input_features={name: features[name] for name in INPUTS},
        output_features={"action": features["action"]},
        normalization_mapping=dict.fromkeys(("ENV", "STATE", "ACTION"), NormalizationMode.MEAN_STD),
        **{"device": "cpu", "push_to_hub": False, "chunk_size": CHUNK, "n_action_steps": EXECUTED},
        **{"dim_model": 128, "n_heads": 4, "dim_feedforward": 512, "n_encoder_layers": 3},
        **{"use_vae": False, "dropout": 0.0, "optimizer_lr": 5e-4},
    )
    policy = ACTPolicy(config).train()
    before, after = make_pre_post_processors(config, dataset_stats=data.meta.stats)
    optimizer = config.get_optimizer_preset().build(policy.get_optim_params())
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, args.steps)
    draw, losses, start = batches(data), [], time.monotonic()
    for step in range(1, args.steps + 1):
        loss, _ = policy.forward(before(next(draw)))
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), LARGEST_GRADIENT)
        optimizer.step()
        schedule.step()
        losses.append(loss.item())
        if step % LOG_EVERY == 0:
            pace = step / (time.monotonic() - start)
            print(f"{step} {np.mean(losses[-LOG_EVERY:]):.4f} {pace:.1f} steps/s", flush=True)
    for part in (policy, before, after):
        part.save_pretrained(args.checkpoint)


def batches(data: LeRobotDataset):
    """Yields random windows; commands after the end of an episode are marked as padding."""
    table = data.hf_dataset.with_format("numpy")
    columns = {
        name: torch.from_numpy(np.stack(table[name][:]).astype(np.float32))
        for name in (*INPUTS, "action")
    }
    episode = np.asarray(table["episode_index"][:])
    last = np.searchsorted(episode, episode, side="right") - 1
    random = np.random.default_rng(0)
    while True:
        frame = random.integers(0, len(episode), BATCH)
        ahead, end = frame[:, None] + np.arange(CHUNK), last[frame][:, None]
        yield {
            **{name: columns[name][frame] for name in INPUTS},
            "action": columns["action"][np.minimum(ahead, end)],
            "action_is_pad": torch.from_numpy(ahead > end),
            "task": [""] * BATCH,
        }


if __name__ == "__main__":
    main()
