"""An arm from outside of starjax, in a scene; `tests/cli/test_run.py` runs it through."""

import importlib
import sys

import gantry
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from starjax.core import errors
from starjax.sim import ik, mounts, registries, robot, scene

EULER = 'euler="3.141592654 0 0"'  # pose of the flange


@pytest.fixture
def package(tmp_path, monkeypatch):
    name = gantry.install(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    for module in ("my_arms", "my_arms.gantry"):
        monkeypatch.delitem(sys.modules, module, raising=False)
    importlib.invalidate_caches()
    return name


def edit(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def test_an_arm_of_another_package_stands_in_a_scene_and_holds_its_tool(package):
    assert package in registries.arms.names() and package not in registries.arms.built_in
    arm, tool = registries.arms.get(package), registries.tools.get("grasper")
    at = mounts.bench(arm, tool)
    assert at.tip.slides == (True, True, True, False, False, False)
    workspace = registries.workspaces.get("board")
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


def test_a_record_whose_lengths_differ_from_the_joints_names_the_field(package):
    arm = registries.arms.get(package)
    with pytest.raises(errors.UsageError) as caught:
        robot.read(arm._replace(max_speed=arm.max_speed[1:]))
    assert caught.value.argument == f"arm {package}: max_speed"
    mounted = {key: mount._replace(home=mount.home[1:]) for key, mount in arm.mounts.items()}
    with pytest.raises(errors.UsageError) as caught:
        robot.read(arm._replace(mounts=mounted))
    assert caught.value.argument.startswith(f"arm {package}: home with ")


@pytest.mark.parametrize("flange", [EULER, 'quat="0 1 0 0"', 'zaxis="0 0.6 -0.8"', ""])
def test_a_scene_turns_the_tool_on_the_flange_as_the_search_did(package, tmp_path, flange):
    edit(tmp_path / "my_arms" / "gantry.xml", EULER, flange)
    edit(tmp_path / "my_arms" / "gantry.py", "turn=0.0", "turn=0.7")
    arm, tool = registries.arms.get(package), registries.tools.get("grasper")
    mount = arm.mounts["grasper", "board"]
    place = jnp.array([*mount.position, mount.yaw, mount.turn, mount.tilt])
    at = mounts.bench(arm, tool)
    pose, _, _ = ik.forward(mounts.standing(at.flange, at.tip, place), jnp.array(mount.home))

    m = scene.compose(scene.name("peg_transfer", arms=(package,)))
    data = mujoco.MjData(m)
    for joint, value in zip(arm.joints, mount.home):
        data.joint(f"arm0/{joint}").qpos = value
    mujoco.mj_forward(m, data)
    tcp = data.site("arm0/tool/tcp")
    np.testing.assert_allclose(tcp.xpos, pose.p, atol=1e-5)
    np.testing.assert_allclose(tcp.xmat.reshape(3, 3), pose.R, atol=1e-5)


@pytest.mark.parametrize(
    ("old", "new", "argument"),
    [
        ('name="flange"', 'name="attachment_site"', "arm gantry"),
        ('name="tilt" joint=', 'name="act5" joint=', "arm gantry"),
        ('range="-2 2"', 'range="-2 2" frictionloss="1"', "arm gantry: joint pitch"),
    ],
)
def test_a_file_that_is_not_ready_is_refused_by_name(package, tmp_path, old, new, argument):
    edit(tmp_path / "my_arms" / "gantry.xml", old, new)
    with pytest.raises(errors.UsageError) as caught:
        robot.read(registries.arms.get(package))
    assert caught.value.argument == argument
