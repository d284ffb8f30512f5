"""An arm from outside of starjax: the one of docs/howto/add-arm.md, built from that page."""

import importlib
import re

import mujoco
import numpy as np
import pytest

from starjax.sim import mounts, registry, scene

FENCE = re.compile(r"^```(\w+)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
GROUP = re.compile(r'entry-points\."([\w.]+)"\]\n(\w+) = "([\w.]+):(\w+)"')


@pytest.fixture
def package(pytestconfig, tmp_path, monkeypatch):
    """The page's blocks as an installed package."""
    page = (pytestconfig.rootpath / "docs" / "howto" / "add-arm.md").read_text()
    blocks = dict(FENCE.findall(page))
    found = GROUP.search(blocks["toml"])
    assert found
    group, name, module, attribute = found.groups()
    folder = tmp_path / module.partition(".")[0]
    folder.mkdir()
    (folder / "__init__.py").touch()
    (folder / "gantry.py").write_text(blocks["py"])
    (folder / "gantry.xml").write_text(blocks["xml"])
    info = tmp_path / "my_arms-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my-arms\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[{group}]\n{name} = {module}:{attribute}\n")
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
