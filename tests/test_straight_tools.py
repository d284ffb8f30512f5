"""Files of straight tools read and score as before tools had a wrist.

The digests were made by commit 9913b49c, the last one before wrists, from the same golden files.
"""

import hashlib
import json

import jax
import numpy as np
import pytest

from starjax.data import load
from starjax.evaluation import result

DATASETS = {"image": "ce9da5cb7c9386f8", "state": "20a5a359cfddb9f7"}
FIGURES = "1a55392061edf067"
DIGITS = 12  # digits of a figure that do not depend on numpy's version


def digest(arrays):
    found = hashlib.sha256()
    for array in jax.tree.leaves(arrays):
        found.update(np.ascontiguousarray(array).tobytes())
    return found.hexdigest()[:16]


def rounded(value):
    if isinstance(value, dict):
        return {name: rounded(value[name]) for name in sorted(value)}
    if isinstance(value, list | tuple):
        return [rounded(item) for item in value]
    return f"{value:.{DIGITS}g}" if isinstance(value, float) else value


@pytest.mark.parametrize("kind", DATASETS)
def test_a_dataset_reads_the_same_bytes(pytestconfig, kind):
    golden = pytestconfig.rootpath / "tests/golden/demonstrations" / kind
    dataset = load.load(golden, residency="host", report=lambda _: None).dataset
    # Rotations of trocars are computed: their last bits depend on the machine.
    read = dataset.replace(trocar=dataset.trocar.trocar)
    assert digest(read) == DATASETS[kind]


def test_a_result_scores_the_same_figures(pytestconfig):
    found = result.read(pytestconfig.rootpath / "tests/golden/result/result.json")
    text = json.dumps(rounded(found.figures), default=str)
    assert hashlib.sha256(text.encode()).hexdigest()[:16] == FIGURES
