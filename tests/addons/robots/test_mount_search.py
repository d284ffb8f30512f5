"""The search for a mount, on an arm of few joints."""

import numpy as np
import pytest

from starjax.addons.robots import mount_search
from starjax.sim import mounts, registries


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(mount_search, "ROUNDS", 2)
    monkeypatch.setattr(mount_search, "GENERATIONS", 6)


@pytest.mark.slow
@pytest.mark.release
def test_a_search_finds_a_mount_from_its_seed_alone(quick):
    at = mounts.bench(registries.arms.get("rcm4"), registries.tools.get("grasper"))
    workspace = registries.workspaces.get("board")
    fits = []
    mount, least = mount_search.search(at, workspace, seed=1, on_round=fits.append)
    again, _ = mount_search.search(at, workspace, seed=1)
    assert again == mount and len(fits) == mount_search.ROUNDS
    assert mount.position == (0.0, 0.0, 0.0) and mount.tilt == 0.0
    found = mounts.worst(mounts.fit(at, mount, mounts.targets(workspace)))
    np.testing.assert_array_equal(found, least)
    assert least.residual < mounts.REACHED and least.margin > 0.05
    assert least.margin == max(fit.margin for fit in fits)
