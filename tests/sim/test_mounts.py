"""Every mount of every arm reaches its whole workspace, with room to spare."""

import functools

import pytest

from starjax.sim import mounts, registry

MOUNTS = [
    (arm, tool, workspace)
    for arm in registry.arms.names()
    for tool, workspace in registry.arms.get(arm).mounts
]


@functools.cache
def targets(workspace):
    return mounts.targets(registry.workspaces.get(workspace))


@pytest.mark.parametrize(("arm", "tool", "workspace"), MOUNTS)
def test_a_mount_reaches_its_workspace_with_room_to_spare(arm, tool, workspace):
    record = registry.arms.get(arm)
    at = mounts.bench(record, registry.tools.get(tool))
    fit = mounts.fit(at, record.mounts[tool, workspace], targets(workspace))
    worst = mounts.worst(fit)
    assert worst.residual < mounts.REACHED
    assert worst.margin >= mounts.MIN_MARGIN
    assert worst.singular >= mounts.MIN_SINGULAR
    assert worst.height > 0 and mounts.is_good(worst)
