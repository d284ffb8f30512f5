"""The script of docs/extend/add-arm.md makes a ready arm of a file like those of Menagerie."""

import re
import sys
import types

import mujoco
import numpy as np
import pytest

from starjax.sim import robot
from starjax.sim.arms.base import Arm

JOINTS = tuple(f"joint{i}" for i in range(1, 8))
AXES = ("0 0 1", "0 1 0", "0 0 1", "0 1 0", "0 0 1", "0 1 0", "0 0 1")


def raw():
    """Seven joints with all that the script takes out: meshes, friction, damping, a keyframe."""
    inside = '<site name="attachment_site" pos="0 0 0.1" quat="0 1 0 0"/>'
    for i in reversed(range(7)):
        inside = f"""<body name="link{i + 1}" pos="0 0.02 0.15">
          <inertial pos="0.03 0 0.05" mass="{2 - 0.2 * i}" diaginertia="0.01 0.01 0.005"/>
          <joint name="{JOINTS[i]}" class="rough" axis="{AXES[i]}" range="-3 3"/>
          <geom type="mesh" mesh="link"/>{inside}</body>"""
    servos = "".join(
        f'<general name="act{i}" joint="{joint}" gainprm="900" biastype="affine" '
        f'biasprm="0 -900 -90" forcerange="-{50 - 5 * i} {50 - 5 * i}"/>'
        for i, joint in enumerate(JOINTS)
    )
    return f"""<mujoco><compiler angle="radian"/>
      <default><default class="rough"><joint damping="10" frictionloss="1"/></default></default>
      <asset><mesh name="link" file="not_there.stl"/></asset>
      <worldbody><body name="base">
        <inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>
        <geom type="mesh" mesh="link"/>{inside}</body></worldbody>
      <actuator>{servos}</actuator>
      <keyframe><key name="home" qpos="0 0 0 1 0 1 0"/></keyframe></mujoco>"""


@pytest.fixture
def converted(pytestconfig, tmp_path, monkeypatch):
    """What the page's names hold after it ran, and the arm that it wrote."""
    page = (pytestconfig.rootpath / "docs" / "extend" / "add-arm.md").read_text()
    (script,) = re.findall(r"^```python\n(.*?)^```$", page, re.DOTALL | re.MULTILINE)
    found = types.SimpleNamespace(spec=lambda entry: mujoco.MjSpec.from_string(raw()))
    stub = types.SimpleNamespace(get=lambda name: found)
    monkeypatch.setitem(sys.modules, "mujoco_menagerie", stub)
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(compile(script, "add-arm.md", "exec"), names)
    arm = Arm("xarm7", str(tmp_path / "xarm7.xml"), "link1", JOINTS, (3.0,) * 7, 100.0, {})
    return names, arm


def test_a_converted_arm_has_what_a_scene_needs(converted):
    names, arm = converted
    m = robot.read(arm).compile()
    assert m.nmesh == 0 and m.nkey == 0 and m.ngeom == 7
    assert not m.geom_contype.any() and not m.geom_conaffinity.any()
    assert not m.dof_frictionloss.any() and not m.dof_damping.any()
    assert (m.body_gravcomp[1:] == 1).all()
    np.testing.assert_allclose(m.dof_armature, m.actuator_forcerange[:, 1] / 100)
    np.testing.assert_allclose(np.abs(m.site("flange").quat), [0, 1, 0, 0])
    data = mujoco.MjData(m)
    data.qpos = names["HOME"]
    mujoco.mj_forward(m, data)
    M = np.zeros((m.nv, m.nv))
    mujoco.mj_fullM(m, data, M)
    w = arm.servo_frequency
    np.testing.assert_allclose(m.actuator_gainprm[:, 0], np.diag(M) * w**2, rtol=1e-4)
    np.testing.assert_allclose(m.actuator_biasprm[:, 2], -np.diag(M) * 2 * w, rtol=1e-4)


def test_a_converted_arm_stands_where_it_is_told(converted):
    names, arm = converted
    m = robot.read(arm).compile()
    data = mujoco.MjData(m)
    data.qpos = data.ctrl = names["HOME"]
    mujoco.mj_step(m, data, 500)
    np.testing.assert_allclose(data.qpos, names["HOME"], atol=1e-5)
