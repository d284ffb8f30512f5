"""The report's files: all of them, none of before, and none of half a report."""

import pytest
import synthetic
from report.conftest import edited

from starjax.report import build, page, style, video
from starjax.runtime import files


@pytest.mark.slow
def test_build_writes_every_file_and_the_same_ones_again(tmp_path):
    run, out = synthetic.run(tmp_path / "stardiff", sweep_of=40), tmp_path / "report"
    out.mkdir()
    for name in ("ports.png", "ports.pdf", "rollout.mp4", "mine.png"):
        (out / name).write_text("of before")
    build.build([run], out, with_video=False)
    written = {path.name: path.read_bytes() for path in out.glob("[!.]*")}
    assert written.pop("mine.png") == b"of before"
    drawn = ["fig3.png", "fig3.pdf", "fig4.png", "fig4.pdf", "training.png"]
    assert sorted(written) == sorted([*drawn, "tables.md", "index.html"])
    for name, data in written.items():
        magic = {"png": b"\x89PNG", "pdf": b"%PDF"}.get(name.split(".")[1], b"")
        assert data.startswith(magic) and len(data) > 500
    build.build([run], out, with_video=False)
    assert {name: (out / name).read_bytes() for name in written} == written


def test_build_without_rollouts_or_results(tmp_path, monkeypatch):
    monkeypatch.setattr(style, "save", lambda *_, **__: b"an image")
    run, out = synthetic.run(tmp_path / "dp_ee", "dp_ee"), tmp_path / "report"
    (run / "evaluation" / "recorded.npz").unlink()
    build.build([run], out)
    assert {"fig3.png", "rollout.mp4"}.isdisjoint(path.name for path in out.iterdir())
    with files.lock(out), pytest.raises(files.StorageError):
        build.build([run], out)
    (run / "result.json").unlink()
    for runs in ([run], []):
        with pytest.raises(ValueError, match="run directory"):
            build.build(runs, out)


@pytest.mark.parametrize("fails", [(page, "render"), (style, "save"), (files, "write_bytes")])
def test_a_report_that_fails_leaves_the_one_before(tmp_path, monkeypatch, fails):
    def fail(*_, **__):
        raise OSError("disk full")

    run, out = synthetic.run(tmp_path / "stardiff"), tmp_path / "report"
    monkeypatch.setattr(style, "save", lambda *_, **__: b"an image")
    build.build([run], out, with_video=False)
    (out / "rollout.mp4").write_text("of before")
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    monkeypatch.setattr(*fails, fail)
    with pytest.raises(OSError, match="disk full"):
        build.build([run], out, with_video=False)
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before


def test_a_machine_without_a_video_encoder_still_gets_the_page(one, tmp_path, monkeypatch):
    def fail(*_):
        raise RuntimeError("no ffmpeg")

    said = []
    for record in (fail, lambda *_: None):
        monkeypatch.setattr(video, "record", record)
        assert build._film([one], tmp_path / "film.mp4", said.append) is None
    assert len(said) == 2 and "no ffmpeg" in said[0]


def test_runs_of_one_method_are_told_apart(one):
    def named(*changes):
        runs = [
            edited(one, **change)._replace(path=one.path / f"{i}/x")
            for i, change in enumerate(changes)
        ]
        return [run.label.removeprefix("STAR-Diff ") for run in build._named_apart(runs)]

    settings = one.result.config
    trained = [{"config": {**settings, "seed": seed}, "seed": 7} for seed in (0, 3)]
    scored = [{"config": settings, "seed": seed} for seed in (0, 7)]
    longer = {"config": {**settings, "train": {**settings["train"], "steps": 9}}, "seed": 7}
    unknown = {"config": {**settings, "seed": None}, "seed": 7}
    fewer = [
        {"trials": [t._replace(seen=t.trocar < count) for t in one.trials]} for count in (1, 2)
    ]
    assert named(*trained) == ["(seed 0)", "(seed 3)"]
    assert named(*scored) == ["(trials of seed 0)", "(trials of seed 7)"]
    assert named(*fewer) == ["(1 trocar)", "(2 trocars)"]
    assert named(scored[0], longer) == named(unknown, trained[0]) == ["(0/x)", "(1/x)"]
    runs = [one._replace(path=one.path / x / "cpu" / "stardiff") for x in "ab"]
    labels = [run.label for run in build._named_apart(runs)]
    assert labels == [f"STAR-Diff ({x}/cpu/stardiff)" for x in "ab"]
