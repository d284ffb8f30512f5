"""Commands relative to the measured pose equal the absolute ones."""

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from starjax.addons.formats import mapping as maps
from starjax.addons.formats import tip_poses

ARM = maps.ArmColumns(
    position="p", rotation="q", command_position="a[0:3]", command_rotation="a[3:7]"
)
DELTA = msgspec.structs.replace(
    ARM, command_rotation="a[3:6]", command_as="delta", command_rotation_as="rotvec"
)


def test_relative_commands_come_after_the_measured_pose():
    rng = np.random.default_rng(0)
    p, step = rng.normal(size=(2, 9, 3))
    before, turn = (Rotation.from_rotvec(rng.normal(size=(9, 3))) for _ in range(2))
    mapping = maps.Map(
        task="reach", arms=(ARM,), units="mm", origin=(0.1, 0.2, 0.3), turn=(0.6, 0.0, 0.8, 0.0)
    )
    measured = {"p": p, "q": before.as_quat()}
    told = {**measured, "a": np.concatenate([p + step, (turn * before).as_quat()], axis=-1)}
    relative = {**measured, "a": np.concatenate([step, turn.as_rotvec()], axis=-1)}
    expected = tip_poses.command(told, ARM, mapping)
    got = tip_poses.command(relative, DELTA, mapping)
    assert expected is not None and got is not None
    np.testing.assert_allclose(got.p, expected.p, atol=1e-9)
    np.testing.assert_allclose(got.R, expected.R, atol=1e-9)


def test_a_mapping_without_it_has_the_record_of_before():
    assert b"command_as" not in msgspec.json.encode(ARM)
