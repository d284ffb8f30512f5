"""Mistakes on the command lines of view and teleop are one line, before anything is compiled."""

import socket

import pytest

from starjax import cli


@pytest.mark.parametrize(
    ("words", "argument"),
    [
        ("view --policy compact --expert", "--dataset"),
        ("view --policy nobody", "--policy"),
        ("view --dataset nowhere", "--dataset"),
        ("view --run nowhere", "RUN"),
        ("view --task nothing", "task"),
        ("view --policy compact --compare-with expert --trocar 99", "--trocar"),
        ("view --arm noodle", "--arm"),
        ("view --port 70000", "--port"),
        ("view --expert --record hand", "--record"),
        ("view --policy compact --compare-with expert --record hand", "--compare-with"),
        ("teleop --task nothing", "task"),
        ("teleop --task reach --trocar 99 --out demos", "--trocar"),
        ("teleop --device joystick", "--device"),
    ],
)
def test_mistakes_are_one_line(words, argument, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert cli.guard(cli.dispatch, words.split()) == 2
    said = capsys.readouterr().err
    (line,) = (line for line in said.splitlines() if line.startswith("starjax: "))
    assert argument in line
    assert not list(tmp_path.iterdir())


def test_a_port_that_is_taken_is_one_line(capsys):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        assert cli.guard(cli.dispatch, ["view", "--task", "reach", "--port", port]) == 2
    said = capsys.readouterr().err
    (line,) = (line for line in said.splitlines() if line.startswith("starjax: "))
    assert port in line and "--port" in line
