"""Every mount of every arm reaches its whole workspace, with room to spare."""

import functools

import numpy as np
import pytest

from starjax.sim import mounts, registries
from starjax.sim.arms.base import opposite

# The first mount of each arm, the others before a release: each is a program of its own.
MOUNTS = [
    pytest.param(arm, tool, workspace, marks=[pytest.mark.release] if i else [])
    for arm in registries.arms.names()
    for i, (tool, workspace) in enumerate(registries.arms.get(arm).mounts)
]


def worst(arm, mount, workspace, tool="grasper"):
    at = mounts.bench(registries.arms.get(arm), registries.tools.get(tool))
    return mounts.worst(mounts.fit(at, mount, targets(workspace, at.wrist)))


@functools.cache
def targets(workspace, wrist):
    return mounts.targets(registries.workspaces.get(workspace), wrist)


@pytest.mark.parametrize(("arm", "tool", "workspace"), MOUNTS)
def test_a_mount_reaches_its_workspace_with_room_to_spare(arm, tool, workspace):
    found = worst(arm, registries.arms.get(arm).mounts[tool, workspace], workspace, tool)
    assert found.residual < mounts.REACHED
    assert found.margin >= mounts.MIN_MARGIN
    assert found.singular >= mounts.MIN_SINGULAR
    assert found.height > 0


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"position": (-0.9, 0.0, 0.2)}, "residual"),
        ({"turn": 1.2}, "margin"),
        ({"position": (-0.58, 0.0, -0.1)}, "height"),
    ],
)
def test_a_worse_mount_is_none(change, field):
    good = registries.arms.get("fr5").mounts["grasper", "board"]
    before, after = (worst("fr5", mount, "board") for mount in (good, good._replace(**change)))
    assert mounts.is_good(before) and not mounts.is_good(after)
    assert abs(getattr(after, field) - getattr(before, field)) > 0.1 * abs(getattr(before, field))


@pytest.mark.slow
def test_a_mount_is_as_good_on_the_other_side():
    left = registries.arms.get("ur5e").mounts["grasper", "left"]
    here, there = worst("ur5e", left, "left"), worst("ur5e", opposite(left), "right")
    np.testing.assert_allclose(here, there, atol=1e-4)


def test_the_trocars_of_every_task_lie_in_its_workspaces():
    for name in registries.tasks.built_in:
        task = registries.tasks.get(name)
        for a, slot in enumerate(task.slots):
            workspace = registries.workspaces.get(slot.workspace)
            assert workspace.p_world_ref == slot.p_world_ref
            assert np.isclose(workspace.roll_zero, slot.roll_zero)
            for field in ("radius", "polar", "azimuth"):
                values = np.asarray(getattr(task.trocars, field))[:, a]
                low, high = getattr(workspace, field)
                if field == "azimuth":
                    values = low + (values - low + 1e-6) % (2 * np.pi) - 1e-6
                assert (values > low - 1e-6).all() and (values < high + 1e-6).all(), (name, field)
