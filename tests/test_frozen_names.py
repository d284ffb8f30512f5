"""Names and texts that are data: hashed into digests, seeds of draws, keys of weights and files.

An edit that changes one of them makes users collect their demonstrations anew, refuses their
checkpoints or changes the draws of a disturbance.
"""

import json
import pathlib
import zlib

import jax
import pytest

from starjax.data import schema, store
from starjax.evaluation.disturbances import DISTURBANCES, base
from starjax.policies import packaged, policy_file
from starjax.sim import env, registries

GOLDEN = pathlib.Path(__file__).parent / "golden" / "frozen_names.json"
# Parts of a dataset's description that no processor, version or setting of jax changes.
PARTS = ("schema", "per_trocar", "expert", "scene", "task", "features", "seed_rule")


def datasets() -> dict[str, str]:
    """Digests of what a dataset of each task says, numbers aside."""
    digests = {}
    for name in registries.tasks.names():
        made = env.make(name)
        settings = schema.DemoSettings(per_trocar=1, seed=0, max_steps=10)
        described = schema.describe(made, made.task.trocars, settings)
        digests[name] = store.digest({part: described[part] for part in PARTS})
    return digests


def weights() -> list[str]:
    """Keys of the weights and statistics of the packaged policy."""
    trained = policy_file.load(packaged.locate("compact"))
    tree = {"params": trained.params, "normalizer": trained.normalizer}
    return [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(tree)]


def streams() -> dict[str, int]:
    """The number that each disturbance folds into its key."""
    return {name: zlib.crc32(base.stream(name).encode()) for name in DISTURBANCES.names()}


FROZEN = {"datasets": datasets, "weights": weights, "streams": streams}


@pytest.mark.parametrize("part", FROZEN)
def test_names_that_are_data_are_what_they_were(part):
    frozen = json.loads(GOLDEN.read_text())[part]
    now = FROZEN[part]()
    if isinstance(frozen, dict):
        now = {name: now[name] for name in frozen}  # a new task or disturbance adds to them
    assert now == frozen
