"""Files of commit 4bec7307 open with today's code: a run, its demonstrations, its policy.

golden/opened/run_4bec7307.zip: `starjax run --preset smoke --task reach` with networks of 8 to 16
channels, without checkpoints and report.
"""

import pathlib
import zipfile

import numpy as np
import pytest

from starjax.cli import demonstrations, folders
from starjax.core import config, config_json
from starjax.data import load
from starjax.evaluation import evaluate, result
from starjax.evaluation import trials as tables
from starjax.policies import policy_file
from starjax.runtime import files
from starjax.sim import env

ZIP = pathlib.Path(__file__).parent / "golden" / "opened" / "run_4bec7307.zip"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The run's folder."""
    root = tmp_path_factory.mktemp("opened")
    zipfile.ZipFile(ZIP).extractall(root)
    return root / "smoke"


def test_demonstrations_are_read_and_accepted_for_training(run):
    (root,) = run.glob("demos-*")
    loaded = load.load(root, residency="host", report=lambda line: None)
    assert loaded.digest == folders.demos_digest(root)
    assert loaded.description["scene"]["task"] == "reach"
    assert np.asarray(loaded.dataset.command.pose.p).shape[1:] == (1, 3)
    settings = folders.read_config(run / "stardiff")
    chosen = config.RunConfig(
        demos=config.DemosConfig(from_=str(root)), policy=settings.policy, scene=settings.scene
    )
    made = env.make("reach", observation="state")
    assert demonstrations.given(chosen, made) == root


def test_a_policy_has_its_weights_and_settings(run):
    trained = policy_file.load(run / "stardiff" / "policy.safetensors")
    plan = files.read_json(run / "stardiff" / "evaluation" / "plan.json")
    assert evaluate.fingerprint((trained.params, trained.normalizer)) == plan["weights"]
    assert trained.method == "stardiff" and trained.scene.task == "reach"
    assert trained.policy.options.unet_channels == (8, 16)
    assert config_json.as_json(trained.policy) == plan["identity"]["policy"]


def test_a_result_and_its_trials_are_read(run):
    scored = result.read(run / "stardiff" / "result.json")
    assert scored.figures["strict"]["seen"]["trials"] == 8
    chunks = sorted((run / "stardiff" / "evaluation").glob("chunk_*.npz"))
    table = tables.join([tables.from_columns(dict(np.load(chunk))) for chunk in chunks])
    assert len(table.success) == 12 and not table.success.any()
