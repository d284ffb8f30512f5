"""LeRobot's ACT from an export to a score: trained, served, evaluated, and by `lerobot-eval`.

    python tests/addons/peers/lerobot_closed_loop.py PEER_PYTHON

PEER_PYTHON is a Python 3.12 with `lerobot[training]`, starjax[gym,sim,serve] and the plugin of
plugins/lerobot_env_starjax. A few steps of training: the numbers say that all parts fit, and that
commands in rcm4 pass the trocar. Without LeRobot nothing is run.
"""

import json
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[3]
SIZE = 64  # pixels of an image
TRAIN = """-m lerobot.scripts.lerobot_train --dataset.repo_id=me/demos --dataset.root={0}/export
--policy.type=act --policy.push_to_hub=false --policy.device=cpu --steps=3 --save_freq=3
--policy.pretrained_backbone_weights=null --policy.chunk_size=8 --policy.n_action_steps=8
--policy.dim_model=64 --policy.n_heads=2 --policy.dim_feedforward=64 --batch_size=4 --num_workers=0
--wandb.enable=false --output_dir={0}/train"""
EDIT = """-m lerobot.scripts.lerobot_edit_dataset --repo_id me/demos --root {0}/export
--new_repo_id me/cut --new_root {0}/cut --operation.type delete_episodes
--operation.episode_indices [1]"""
CHECKPOINT = "train/checkpoints/last/pretrained_model"
SERVE = "{1}/examples/14_serve_lerobot.py {0}/{2} --port 0"
EVAL = """-m lerobot.scripts.lerobot_eval --policy.path={0}/{2} --policy.device=cpu
--env.type=starjax --env.image_size={3} --env.trocar_in_state=true --env.actions=rcm4
--env.trocars=seen --env.max_episode_steps=10 --eval.batch_size=2 --eval.n_episodes=2
--output_dir={0}/lerobot_eval"""
SCORE = "--eval.trials=1 --eval.time-limit-s=2 --no-video"


def main(python):
    found = subprocess.run([python, "-c", "import lerobot_env_starjax"], capture_output=True)
    if found.returncode:
        print(f"{python}: LeRobot or the plugin is not installed there; nothing was run")
        return 0
    with tempfile.TemporaryDirectory() as folder:
        return closed_loop(python, folder)


def closed_loop(python, folder):
    import recorded

    recorded.write(Path(folder, "demos"), size=SIZE)
    ours("export", f"{folder}/demos", f"{folder}/export", "--state-with-trocar", "--actions=rcm4")

    def peer(command, run=subprocess.run, **options):
        words = command.format(folder, ROOT, CHECKPOINT, SIZE).split()
        environment = {**os.environ, "HF_HUB_OFFLINE": "1", "JAX_PLATFORMS": "cpu"}
        return run([python, *words], env=environment, text=True, **options)

    peer(EDIT, check=True)
    ours("import", f"{folder}/cut", f"{folder}/again")
    peer(TRAIN, check=True)
    with peer(SERVE, subprocess.Popen, stdout=subprocess.PIPE) as server:
        try:
            lines = iter(server.stdout.readline, "")
            address = next(
                found[0] for found in (re.search(r"ws://\S+", line) for line in lines) if found
            )
            ours("evaluate", "--policy", address, "--out", f"{folder}/score", *SCORE.split())
        finally:
            server.terminate()
    peer(EVAL, check=True)
    trials = json.loads(Path(folder, "score/result.json").read_text())["trials"]
    worst = max(trial["rcm_max_mm"] for trial in trials)
    groups = json.loads(Path(folder, "lerobot_eval/eval_info.json").read_text())["per_group"]
    successes = sum(trial["success"] for trial in trials)
    print(f"starjax evaluate: {successes} of {len(trials)}, RCM error at most {worst:.2f} mm")
    print(f"lerobot-eval: {groups['seen']['n_episodes']} episodes of the group seen")
    return 0 if worst < 1.0 else 1


def ours(*command):
    subprocess.run([sys.executable, "-m", "starjax", *command], check=True)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    sys.path.append(str(ROOT / "tests"))
    sys.exit(main(sys.argv[1]))
