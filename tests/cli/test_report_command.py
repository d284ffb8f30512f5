"""`starjax report`: which folders a command line names."""

import shutil

import mistakes
import synthetic

from starjax.cli import report_command
from starjax.report import build


def test_folders_are_found_once_and_the_report_lies_beside_them(tmp_path, monkeypatch):
    built = []
    monkeypatch.setattr(build, "build", lambda runs, out, **_: built.append((runs, out)))
    run = synthetic.run(tmp_path / "all" / "stardiff")
    shutil.copytree(run, run / "evaluate-seed1-6x60s")  # within a method's folder: no run of it
    other = shutil.copytree(run, tmp_path / "compact-seed0-4x30s")
    for typed in ([str(run.parent), f"{run}/../stardiff"], [str(other)], [str(other), str(run)]):
        assert report_command.main(typed) == 0
    first, second, third = built
    assert first == ([run], run.parent / "report")
    assert second == ([other], other / "report")
    assert third[0] == [other, run]


def test_the_reference_of_paired_tests_is_one_of_the_methods(tmp_path):
    for seed, name in enumerate(("dp_rcm1", "dp_rcm2")):
        synthetic.run(tmp_path / name, name, seed=seed)
    with mistakes.of("against", "'dp_rcm4'"):
        report_command.main([str(tmp_path), "--no-video", "--against", "dp_rcm4"])
    assert report_command.main([str(tmp_path), "--no-video", "--against", "dp_rcm2"]) == 0
    tables = (tmp_path / "report" / "tables.md").read_text()
    assert "Paired comparison with DP-RCM-2" in tables and "| DP-RCM-1 | 72 |" in tables
