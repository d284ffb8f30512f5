"""`starjax robot FILE --check`: its exit status, and nothing sent."""

import pytest

pytest.importorskip("cyclonedds")

import loopback

from starjax import deploy
from starjax.addons.robots import robot
from starjax.deploy import in_process


@pytest.mark.parametrize(
    ("line", "status", "text"),
    [
        ("", 0, "/PSM1/servo_jp"),
        ('instrument = "prograsp"', 1, "- frames: "),
        ('frame = "PSM2_base"', 1, "- message: measured_cp.header.frame_id"),
    ],
)
def test_a_check_has_a_table_and_a_status(tmp_path, monkeypatch, capsys, line, status, text):
    monkeypatch.setattr(deploy, "load", lambda name: name)
    monkeypatch.setattr(in_process, "InProcess", lambda policy: loopback.Circle())
    loopback.file_of(tmp_path, arm=line)
    with loopback.robot() as process:
        argv = [str(tmp_path / "robot.toml"), "--check", "--wait-s", "20"]
        assert robot.main(argv) == status
        assert text in capsys.readouterr().out
        assert process.end()["commands"] == 0
