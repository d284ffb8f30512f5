"""The search for a mount, on an arm of few joints."""

import numpy as np
import pytest

from starjax.sim import mounts, place, registry


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(place, "ROUNDS", 2)
    monkeypatch.setattr(place, "GENERATIONS", 6)


@pytest.mark.slow
def test_a_search_finds_a_mount_from_its_seed_alone(quick):
    at = mounts.bench(registry.arms.get("rcm4"), registry.tools.get("grasper"))
    workspace = registry.workspaces.get("board")
    told = []
    mount, least = place.search(at, workspace, seed=1, tell=told.append)
    again, _ = place.search(at, workspace, seed=1)
    assert again == mount and len(told) == place.ROUNDS
    assert mount.position == (0.0, 0.0, 0.0) and mount.tilt == 0.0
    found = mounts.worst(mounts.fit(at, mount, mounts.targets(workspace)))
    np.testing.assert_array_equal(found, least)
    assert least.residual < mounts.REACHED and least.margin > 0.05
    assert least.margin == max(fit.margin for fit in told)
