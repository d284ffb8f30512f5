"""A tool with a wrist from outside of starjax, held by the dVRK's arm."""

import importlib
import sys

import gantry
import mujoco
import numpy as np
import pytest

from starjax import rcm
from starjax.sim import mounts, registries, scene
from starjax.testing import base
from starjax.testing import tools as checks


@pytest.fixture
def tool(tmp_path, monkeypatch):
    name = gantry.install(tmp_path, "add-tool")
    monkeypatch.syspath_prepend(tmp_path)
    for module in ("my_tools", "my_tools.mega"):
        monkeypatch.delitem(sys.modules, module, raising=False)
    importlib.invalidate_caches()
    return registries.tools.get(name)


def test_a_tool_of_another_package_has_no_fault_and_an_arm_holds_it(tool):
    found = {check.subject: check.status for check in checks.check(tool.name, 1)}
    assert "wrist" in found and set(found.values()) == {base.OK}
    arm, workspace = registries.arms.get("psm"), registries.workspaces.get("board")
    mount = registries.mount(arm, tool.name, "board")
    fit = mounts.fit(mounts.bench(arm, tool), mount, mounts.targets(workspace, tool.wrist))
    assert mounts.is_good(fit)


def test_its_scene_bends_it_as_the_maps_do(tool):
    m = scene.compose(scene.name("peg_transfer", ["psm"], [tool.name]))
    data, angles = mujoco.MjData(m), (1.1, -0.5)
    for joint, angle in zip(tool.wrist_joints, angles):
        data.joint(f"arm0/tool/{joint}").qpos = angle
    mujoco.mj_forward(m, data)
    shaft, tip = (data.site(f"arm0/tool/{name}") for name in (tool.shaft, tool.tcp))
    pose = rcm.Pose(shaft.xmat.reshape(3, 3), shaft.xpos)
    bent = rcm.tip_of(tool.wrist, pose, angles)
    np.testing.assert_allclose(tip.xpos, bent.p, atol=1e-6)
    np.testing.assert_allclose(tip.xmat.reshape(3, 3), bent.R, atol=1e-5)
