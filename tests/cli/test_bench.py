"""`starjax bench`: its rows and its file."""

import dataclasses
import json
import types

import fakes
import mistakes
import pytest

from starjax import cli
from starjax.cli import bench, folders, policy_args, presets
from starjax.core import config

SMOKE = presets.PRESETS["smoke"]


@pytest.fixture
def scored(tmp_path):
    """The part of a method's folder that bench reads."""
    folder = tmp_path / "stardiff"
    folder.mkdir()
    folders.claim(folder, SMOKE, "demos-a")
    (folder / "result.json").write_text('{"method": "stardiff"}')
    return folder


def test_bench_writes_beside_the_result_of_the_folder_it_is_in(scored, monkeypatch, capsys):
    timed = {"weights": "a"}
    monkeypatch.setattr(
        bench,
        "_time",
        lambda args, path: {**timed, "method": path.run.name, "timed": path.run.name},
    )
    monkeypatch.chdir(scored)
    assert bench.main(["."]) == 0
    assert capsys.readouterr().out.endswith(f"starjax report {scored} shows it\n")
    found = json.loads((scored / "bench.json").read_text())
    assert (found["method"], found["timed"]) == ("stardiff", "stardiff")
    assert found["hardware"]["cores"] >= 1 and found["versions"]["starjax"]
    assert json.loads((scored / "result.json").read_text()) == {"method": "stardiff"}
    (scored / "result.json").write_text('{"method": "stardiff", "weights": "b"}')
    assert bench.main(["."]) == 0
    assert "shows it once starjax run has scored these weights" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("flags", "counts"), [([], (1, 2, 5, 10, 20, 50)), (["--ddim-steps", "3", "60"], (3, 60))]
)
def test_bench_times_what_table_iv_has_and_the_policy_can(scored, monkeypatch, flags, counts):
    few = config.with_options(SMOKE.policy, diffusion_steps=60)
    folders.claim(scored, dataclasses.replace(SMOKE, policy=few), "demos-a")
    timed = []
    monkeypatch.setattr(bench, "_time", lambda *given: timed.append(given) or {"weights": "a"})
    assert bench.main([str(scored), *flags]) == 0
    ((args, path),) = timed
    assert (path.run, args.calls) == (scored, 100)
    policy = folders.read_config(scored).policy
    assert tuple(bench._ddim_steps(args, policy)) == counts
    with mistakes.of("--ddim-steps", 61):
        bench.main([str(scored), "--ddim-steps", "61"])


def test_a_packaged_policy_is_timed_into_a_folder_of_its_own(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(bench, "_time", lambda *_: {"weights": "a"})
    assert bench.main(["--policy", "compact"]) == 0
    (file,) = tmp_path.rglob("bench.json")
    assert str(file.relative_to(tmp_path)) in capsys.readouterr().out
    for words in (["--policy", "compact", "x"], []):
        with mistakes.of("RUN or --policy"):
            bench.main(words)
    with mistakes.of("--policy", "ws://"):
        bench.main(["--policy", "ws://127.0.0.1:8000"])


def test_bench_promises_nothing_after_ctrl_c(scored, monkeypatch, capsys):
    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(bench, "_time", stop)
    assert cli.guard(bench.main, [str(scored)]) == 130
    said = capsys.readouterr().err
    assert "bench saves its figures only at its end" in said and "same command" not in said
    assert not (scored / "bench.json").exists()


@pytest.mark.parametrize(("method", "timed"), [("stardiff", True), ("dp_rcm4", False)])
def test_only_the_hierarchy_has_a_roll_network_to_time(
    monkeypatch, capsys, tmp_path, method, timed
):
    from starjax.evaluation import latency

    ms = {"p50": 4.0, "p95": 5.0, "p99": 8.0}
    trained = fakes.trained()
    env = fakes.env()
    who = types.SimpleNamespace(trained=trained, env=env, weights="a")
    monkeypatch.setattr(policy_args, "load", lambda path: (who, None))
    monkeypatch.setattr(latency, "table", lambda *_, **__: iter([{"ddim_steps": 2, **ms}]))
    monkeypatch.setattr(latency, "roll_ms", lambda *_, **__: ms)
    args = bench.BenchArgs(run=str(tmp_path / method), ddim_steps=(2,), calls=1)
    path = policy_args.PolicyPath(tmp_path, tmp_path / method)
    assert bool(bench._time(args, path)["roll_network_ms"]) == timed
    assert capsys.readouterr().out.splitlines()[1].split() == [
        "2",
        "4.000",
        "5.000",
        "8.000",
        "250.0",
    ]
