"""An arm from outside of starjax, in a scene; `tests/experiments/test_run.py` runs it through."""

import importlib

import gantry
import mujoco
import numpy as np
import pytest

from starjax.sim import mounts, registry, scene


@pytest.fixture
def package(tmp_path, monkeypatch):
    name = gantry.install(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    importlib.invalidate_caches()
    return name


def test_an_arm_of_another_package_stands_in_a_scene_and_holds_its_tool(package):
    assert package in registry.arms.names() and package not in registry.arms.built_in
    arm, tool = registry.arms.get(package), registry.tools.get("grasper")
    at = mounts.bench(arm, tool)
    assert at.tip.slides == (True, True, True, False, False, False)
    workspace = registry.workspaces.get("board")
    fit = mounts.fit(at, arm.mounts["grasper", "board"], mounts.targets(workspace))
    assert mounts.is_good(fit)

    m = scene.compose(scene.name("peg_transfer", arms=(package,)))
    data, home = mujoco.MjData(m), np.array(arm.mounts["grasper", "board"].home)
    for joint, value in zip(arm.joints, home):
        data.joint(f"arm0/{joint}").qpos = value
        data.actuator(f"arm0/{joint}").ctrl = value
    mujoco.mj_forward(m, data)
    before = data.site("arm0/tool/tcp").xpos.copy()
    assert np.linalg.norm(before[:2]) < 0.01 and 0 < before[2] < 0.15  # through the trocar
    mujoco.mj_step(m, data, 480)
    np.testing.assert_allclose(data.site("arm0/tool/tcp").xpos, before, atol=1e-4)
