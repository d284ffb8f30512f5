"""Trackers get the lines of the training log, from a fake package of each."""

import json
import sys
import types

import pytest

from starjax.training import log, trackers

LINES = [(20, "train", {"loss": 0.5, "skipped": 0}), (40, "holdout", {"error": 0.25})]
EXPECTED = [(20, {"train/loss": 0.5, "train/skipped": 0}), (40, {"holdout/error": 0.25})]


def tensorboardx(calls):
    class SummaryWriter:
        def __init__(self, folder, purge_step):
            calls.append(("opened", folder, purge_step))

        def add_scalar(self, name, value, step):
            calls.append((step, {name: value}))

        def flush(self):
            pass

        def close(self):
            calls.append("closed")

    return types.SimpleNamespace(SummaryWriter=SummaryWriter)


def wandb(calls):
    def init(*, project, name, dir, config, resume):
        json.dumps(config)
        calls.append(("opened", dir, name))
        log = lambda values, step: calls.append((step, values))  # noqa: E731
        return types.SimpleNamespace(log=log, finish=lambda: calls.append("closed"))

    return types.SimpleNamespace(init=init)


def tracked(name, folder):
    with trackers.following(name, folder, {"seed": 0}):
        for line in LINES:
            log.append(folder / "metrics.jsonl", *line)


@pytest.mark.parametrize(
    ("name", "package", "fake"),
    [("tensorboard", "tensorboardX", tensorboardx), ("wandb", "wandb", wandb)],
)
def test_a_tracker_gets_every_line_of_the_log(name, package, fake, tmp_path, monkeypatch):
    calls = []
    monkeypatch.setitem(sys.modules, package, fake(calls))
    tracked(name, tmp_path)
    opened, *got, closed = calls
    assert opened[0] == "opened" and opened[1].startswith(str(tmp_path)) and closed == "closed"
    values = {step: {} for step, *_ in LINES}
    for step, added in got:
        values[step] |= added
    assert list(values.items()) == EXPECTED


def test_the_log_is_the_same_with_a_tracker_and_without(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", wandb([]))
    texts = []
    for name in ("none", "wandb"):
        (tmp_path / name).mkdir()
        tracked(name, tmp_path / name)
        texts.append((tmp_path / name / "metrics.jsonl").read_bytes())
    assert texts[0] == texts[1]


def test_no_package_is_imported_before_the_first_line(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", None)  # its import would raise
    with trackers.following("wandb", tmp_path, {}):
        pass
    log.append(tmp_path / "metrics.jsonl", *LINES[0])  # nothing follows any longer


def test_what_happens_at_a_resume_replaces_the_steps_from_there_on(tmp_path, monkeypatch):
    calls = []
    monkeypatch.setitem(sys.modules, "tensorboardX", tensorboardx(calls))
    tracked("tensorboard", tmp_path)
    assert calls[0][2] == LINES[0][0]
