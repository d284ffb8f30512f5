"""The scene of a run, by name: the task's defaults, and mistakes that name their flag."""

import contextlib

import fakes
import mistakes
import pytest

from starjax import cli
from starjax.cli import folders, scenes
from starjax.core import config


def test_names_that_are_left_out_are_the_tasks():
    found = scenes.resolved(config.RunConfig()).scene
    assert found == scenes.settings(fakes.SCENE)
    assert scenes.resolved(config.RunConfig(scene=found)).scene == found
    both = config.SceneConfig(task="peg_transfer_bimanual", arm=("fr5",))
    assert scenes.resolved(config.RunConfig(scene=both)).scene.arm == ("fr5", "fr5")


@pytest.mark.parametrize(
    ("scene", "argument"),
    [
        ({"task": "pegtransfer"}, "task"),
        ({"arm": ("fr6",)}, "arm"),
        ({"arm": ("fr5", "fr5")}, "arm"),
        ({"tool": ("hook",)}, "tool"),
        ({"camera": ("ceiling",)}, "camera"),
    ],
)
def test_an_unknown_name_is_a_mistake_of_its_flag(scene, argument):
    with mistakes.of(argument):
        scenes.resolved(config.RunConfig(scene=config.SceneConfig(**scene)))


def test_a_task_gives_all_its_seen_trocars_and_no_more():
    def asked(count):
        return config.RunConfig(demos=config.DemosConfig(seen_trocars=count))

    assert scenes.resolved(config.RunConfig()).demos.seen_trocars == 8
    assert scenes.resolved(asked(3)).demos.seen_trocars == 3
    with mistakes.of("demos.seen_trocars", 9):
        scenes.resolved(asked(9))


def test_cameras_that_are_named():
    def cameras(**scene):
        found = scenes.resolved(config.RunConfig(scene=config.SceneConfig(**scene)))
        return found.scene.camera

    for camera in (("endoscope",), ("camera", "endoscope")):
        assert cameras(camera=camera) == camera
    assert cameras(task="endoscope_track", camera=("fixed",)) == ("camera",)


def test_a_folder_of_another_scene_is_refused(tmp_path):
    first = scenes.resolved(config.RunConfig())
    folders.claim(tmp_path, first, "demos-a")
    (tmp_path / "policy.safetensors").touch()
    other = scenes.resolved(config.RunConfig(scene=config.SceneConfig(task="reach")))
    with mistakes.of("scene.task", "reach"):
        folders.claim(tmp_path, other, "demos-a")


def test_the_list_names_everything_that_flags_can(capsys):
    from starjax.cli import presets
    from starjax.core import methods
    from starjax.policies import packaged
    from starjax.sim import registries

    assert cli.dispatch(["list"]) == 0
    said = {line.split()[0] for line in capsys.readouterr().out.splitlines() if line[:2] == "  "}
    for known in (registries.tasks, registries.arms, registries.tools, packaged):
        assert said >= {*known.names()}
    assert said >= {*methods.METHODS, *presets.PRESETS}


def test_a_package_that_cannot_be_imported_is_a_line_of_the_list(monkeypatch, capsys):
    import importlib.metadata

    from starjax.sim import registries

    broken = importlib.metadata.EntryPoint("sew", "nowhere_at_all:TASK", "starjax.tasks")
    monkeypatch.setattr(
        registries.Registry, "_entries", lambda self: [broken] if self.kind == "task" else []
    )
    assert cli.dispatch(["list"]) == 0
    (line,) = [x for x in capsys.readouterr().out.splitlines() if x.split()[:1] == ["sew"]]
    assert "cannot be used" in line and "nowhere_at_all" in line


@pytest.mark.parametrize(
    ("task", "tool", "method", "argument"),
    [
        ("reach", "grasper", "stardiff_pose", "tool"),
        ("peg_transfer", "needle_driver", "dp_ee_wrist", ""),
        ("peg_transfer", "needle_driver", "stardiff", ""),
        ("needle_handover", "needle_driver", "stardiff_pose", ""),
    ],
)
def test_methods_go_with_tools_that_they_can_move(task, tool, method, argument):
    scene = config.SceneConfig(task=task, tool=(tool,))
    scene = scenes.resolved(config.RunConfig(scene=scene)).scene
    with mistakes.of(argument) if argument else contextlib.nullcontext():
        scenes.check_wrists(scene, [method])
