"""The patient side manipulator is the dVRK's: its Denavit-Hartenberg parameters, joint by joint."""

import mujoco
import numpy as np
import pytest

from starjax.addons.robots import crtk, psm
from starjax.sim import assets, registries, robot

N = 10_000
# Offset of the roll's frame (m) of two instruments in the dVRK's descriptions.
OFFSETS = {"needle_driver": 0.4162, "prograsp": 0.4670}


# Ranges and largest torques of kinematic/psm.json, psm-si.json, and of both tools' descriptions:
# outer yaw, pitch, insertion; roll, wrist pitch and yaw. The yaw of psm.json has whole turns: that
# range of the user guide, +-91 degrees, in its place.
RANGES = {
    "psm": [(-1.5882, 1.5882), (-0.925025, 0.925025), (0.0, 0.24)],
    "psm_si": [(-2.964, 2.964), (-1.265, 1.301), (0.0, 0.29)],
}
TORQUES = {"psm": [4.97, 4.97, 14.81], "psm_si": [17.0845, 17.0845, 40.9063]}
TOOL_RANGES = [(-4.53786, 4.53786), (-1.39626, 1.39626), (-1.39626, 1.39626)]
TOOL_TORQUES = [0.33, 0.25, 0.20]
# Largest speeds of the dVRK's own trajectories (mtsIntuitiveResearchKitPSM): rad/s, m/s.
SPEEDS = [np.pi, np.pi, 0.2, 6.0 * np.pi, 6.0 * np.pi, 6.0 * np.pi]


def modified(alpha, a, theta, d):
    """Transforms `[N, 4, 4]` of modified Denavit-Hartenberg parameters."""
    c, s, zero = np.cos(theta), np.sin(theta), np.zeros_like(theta)
    ca, sa = np.cos(alpha), np.sin(alpha)
    rows = (
        [c, -s, zero, zero + a],
        [s * ca, c * ca, zero - sa, zero - sa * d],
        [s * sa, c * sa, zero + ca, zero + ca * d],
        [zero, zero, zero, zero + 1.0],
    )
    return np.moveaxis(np.array(rows), -1, 0)


def described(q, tool):
    """Frames `[N, 4, 4]` of shaft and yaw axis at joints `[N, 6]`, by psm.json and the tool's."""
    half, clevis = np.pi / 2, registries.tools.get(tool).wrist.clevis
    zero = np.zeros(len(q))
    rows = [
        (half, 0.0, q[:, 0] + half, 0.0),
        (-half, 0.0, q[:, 1] - half, 0.0),
        (half, 0.0, zero, q[:, 2] - 0.4318),
        (0.0, 0.0, q[:, 3], OFFSETS[tool]),
        (-half, 0.0, q[:, 4] - half, 0.0),
        (-half, clevis, q[:, 5] - half, 0.0),
    ]
    frames = [np.eye(4)]
    for row in rows:
        frames.append(frames[-1] @ modified(*row))
    # "tooltip-offset" of the instrument: z along the jaws.
    tip = np.array([[0, -1, 0, 0], [0, 0, 1, 0], [-1, 0, 0, 0], [0, 0, 0, 1.0]])
    return frames[4], frames[6] @ tip


def drawn(arm):
    rng = np.random.default_rng(0)
    m = robot.read(registries.arms.get(arm)).compile()
    limits = np.concatenate([m.jnt_range, np.full((2, 2), [-1.39626, 1.39626])])
    return rng.uniform(*limits.T, (N, 6))


@pytest.fixture(scope="module", params=OFFSETS)
def tool(request):
    return request.param


def compiled(arm, tool):
    """Returns the model of an arm with its tool, and the names of its six joints."""
    record, held = registries.arms.get(arm), registries.tools.get(tool)
    part = robot.read(record)
    hand = mujoco.MjSpec.from_file(str(assets.path(held.mjcf)))
    part.attach(hand, site=part.site(robot.FLANGE), prefix="tool/")
    return part.compile(), (*record.joints, *(f"tool/{joint}" for joint in held.wrist_joints))


@pytest.mark.parametrize("arm", ["psm", "psm_si"])
def test_ranges_torques_and_speeds_are_those_of_the_public_description(arm, tool):
    m, names = compiled(arm, tool)
    ranges = [m.joint(name).range for name in names]
    np.testing.assert_allclose(ranges, RANGES[arm] + TOOL_RANGES, atol=1e-5)
    torques = [m.actuator(name).forcerange for name in names]
    expected = np.array(TORQUES[arm] + TOOL_TORQUES)
    np.testing.assert_allclose(torques, np.stack([-expected, expected], -1), rtol=5e-4)
    record, held = registries.arms.get(arm), registries.tools.get(tool)
    speeds = [*record.max_speed, *[held.wrist_speed] * len(held.wrist_joints)]
    np.testing.assert_allclose(speeds, SPEEDS)


@pytest.mark.parametrize("arm", ["psm", "psm_si"])
def test_the_model_has_the_frames_of_the_public_description(arm):
    q, tool = drawn(arm), "needle_driver"
    held = registries.tools.get(tool)
    m, names = compiled(arm, tool)
    data = mujoco.MjData(m)
    index = [m.joint(name).qposadr[0] for name in names]
    sites = [data.site(f"tool/{name}") for name in ("shaft", "tcp")]
    frames = np.zeros((N, 2, 4, 3))
    for row, there in zip(q, frames):
        data.qpos[index] = row
        mujoco.mj_kinematics(m, data)
        for site, frame in zip(sites, there):
            frame[:3], frame[3] = site.xmat.reshape(3, 3), site.xpos
    shafts, tips = described(q, tool)
    tips = tips @ homogeneous(crtk.tool_tip(held.wrist))
    for frame, expected in zip(frames.swapaxes(0, 1), (shafts, tips)):
        np.testing.assert_allclose(frame[:, :3], expected[:, :3, :3], atol=1e-5)
        np.testing.assert_allclose(frame[:, 3], expected[:, :3, 3], atol=1e-5)  # m


def homogeneous(pose):
    return np.block([[pose.R, pose.p[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])


def test_closed_forms_agree_with_it_and_with_each_other(tool):
    q = drawn("psm")[:40]
    q[:, 2] = np.maximum(q[:, 2], 0.03)  # the wrist is through the trocar
    instrument = {"needle_driver": psm.LARGE_NEEDLE_DRIVER, "prograsp": psm.PROGRASP}[tool]
    shafts, tips = described(q, tool)
    for row, shaft_at, tip_at in zip(q, shafts, tips):
        shaft, tip = psm.shaft_of(row, instrument), psm.tip_of(row, instrument)
        np.testing.assert_allclose(shaft.R, shaft_at[:3, :3], atol=1e-9)
        np.testing.assert_allclose(shaft.p, shaft_at[:3, 3], atol=1e-9)
        expected = tip_at @ homogeneous(crtk.tool_tip(instrument.wrist))
        np.testing.assert_allclose(tip.R, expected[:3, :3], atol=1e-9)
        np.testing.assert_allclose(tip.p, expected[:3, 3], atol=1e-9)
        found = psm.joints_of(tip, instrument)
        np.testing.assert_allclose(np.sin(found - row), 0.0, atol=2e-5)
        np.testing.assert_allclose(psm.tip_of(found, instrument).p, tip.p, atol=1e-6)
        other = psm.tip_of(psm.half_turn(row), instrument)
        np.testing.assert_allclose(other.R, tip.R @ np.diag([-1.0, -1.0, 1.0]), atol=1e-9)
        np.testing.assert_allclose(other.p, tip.p, atol=1e-9)
