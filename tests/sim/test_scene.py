"""A scene of several processes."""

import pathlib

import several

JOB = pathlib.Path(__file__).with_name("scene_job.py")


def test_each_process_has_its_scene_on_a_device_of_its_own():
    started = several.start(JOB)
    said = several.finish(started)
    assert [process.returncode for process in started] == [0, 0], said
