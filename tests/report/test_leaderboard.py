"""Rows of the trocar benchmark from results of evaluate, sweep and stress, made up."""

import json

import mistakes
import pytest
import synthetic

from starjax.cli import leaderboard as command
from starjax.core import config, config_json
from starjax.evaluation import protocol
from starjax.report import leaderboard, leaderboard_tables
from starjax.runtime import files


def stress(file, weights=synthetic.WEIGHTS, version=protocol.VERSION, **changed):
    """stress.json of two disturbances."""
    error = {"rcm_error_mm": {"executed": {"mean": 0.01, "p99": 0.02}}}
    score = {"strict": {"successes": 54, "trials": 108}, **error}
    content = {
        "scene": {"task": "peg_transfer", "arms": ["fr5"], "tools": [], "cameras": []},
        "method": "dp_ee",
        "weights": weights,
        "seed": 0,
        "trials_at_each_trocar": protocol.STRESS_TRIALS,
        "time_limit_s": 60.0,
        "disturbances": {
            "camera": {
                "unit": "mm",
                "levels": {"2": {"strict": {"successes": 1, "trials": 2}, **error}, "10": score},
            },
            "observation_delay": {"unit": "steps", "levels": {"4": score}},
        },
        "commit": "c0ffee",
        "command": "starjax stress",
    }
    files.write_json(file, {**content, "benchmark_version": version, **changed})
    return file


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two methods, the worse one with a sweep and a stress; a result of other trials."""
    out = tmp_path_factory.mktemp("leaderboard")
    synthetic.run(out / "dp_ee", "dp_ee", (0.5, 0.1), trials=50, sweep_of=200)
    synthetic.run(out / "stardiff", "stardiff", (0.95, 0.8), trials=60)
    synthetic.run(out / "few", "dp_rcm4", trials=6, seed=1)
    stress(out / "dp_ee" / "stress.json")
    return out


def test_results_of_one_policy_are_one_row_and_the_best_comes_first(folder):
    rows, others = leaderboard.read(leaderboard.find([folder]))
    best, worst = rows
    assert (best.method, worst.method) == ("STAR-Diff", "DP-EE")
    assert (best.seen.trials, best.unseen.trials) == (400, 200)  # first of 60 at each trocar
    assert best.others is None and best.stressed is None
    assert worst.others.trials == 200 and len(worst.commands) == 3
    assert worst.stress.keys() == {"camera", "observation_delay"}
    assert worst.stressed is None  # two of the protocol's disturbances
    complete = worst._replace(stress=dict.fromkeys(protocol.STRESS, worst.stress["camera"]))
    count = len(protocol.STRESS)
    assert (complete.stressed.successes, complete.stressed.trials) == (54 * count, 108 * count)
    (result,) = others
    assert result.file.endswith("few/result.json") and len(result.reasons) == 2


def test_a_row_names_its_views(folder, tmp_path):
    content = files.read_json(folder / "stardiff" / "result.json")
    (before,) = leaderboard.read([files_of(tmp_path / "plain.json", content)])[0]
    content["scene"]["cameras"], content["observation"] = ["camera", "camera_depth"], "image"
    policy = config.PolicyConfig(depth_encoder="points")
    content["config"] = config_json.as_json(config.RunConfig(policy=policy))
    (row,) = leaderboard.read([files_of(tmp_path / "views.json", content)])[0]
    assert "camera + camera_depth, depth by points" in row.policy
    assert "camera" not in before.policy


def files_of(path, content):
    files.write_json(path, content)
    return path


def test_only_the_first_trials_at_each_trocar_count(folder):
    content = files.read_json(folder / "stardiff" / "result.json")
    first = [t for t in content["trials"] if t["trial"] < 50 and t["seen"]]
    (row, _), _ = leaderboard.read(leaderboard.find([folder]))
    assert row.seen.successes == sum(trial["success"] for trial in first)


@pytest.mark.parametrize("version", [None, protocol.VERSION + 1])
def test_another_version_is_apart_with_a_line(folder, tmp_path, version):
    file = stress(tmp_path / "stress.json", version=version)
    rows, _ = leaderboard.read([*leaderboard.find([folder / "dp_ee"]), file])
    assert len(rows) == 2
    (ours,), (apart,) = leaderboard_tables.current(rows), leaderboard_tables.apart(rows)
    assert ours.seen and apart.seen is None and apart.version == version
    page = leaderboard_tables.markdown(rows, [])
    assert page.index("## Apart") < page.index(leaderboard_tables.reason([apart]))
    assert page.count("DP-EE |") == 2 + 2  # files of scores and of stresses


def test_stresses_of_other_weights_are_not_the_policys(folder, tmp_path):
    file = stress(tmp_path / "stress.json", weights="1" * 64)
    rows, _ = leaderboard.read([*leaderboard.find([folder / "dp_ee"]), file])
    assert [row.weights for row in rows if row.stress] == ["00000000", "11111111"]


def test_a_stress_of_another_level_or_seed_does_not_count(tmp_path):
    rows, others = leaderboard.read([stress(tmp_path / "stress.json", seed=3)])
    assert not rows and "seed 3" in others[0].reasons[0]


def test_the_command_prints_text_markdown_and_json(folder, capsys):
    command.main([str(folder)])
    text = capsys.readouterr().out
    command.main([str(folder), "--markdown"])
    page = capsys.readouterr().out
    assert "| peg_transfer | STAR-Diff |" in page and "STAR-Diff" in text
    command.main([str(folder), "--json"])
    found = json.loads(capsys.readouterr().out)
    assert found["benchmark_version"] == protocol.VERSION and len(found["other_trials"]) == 1
    seen = found["rows"][0]["seen"]
    assert 0 < seen["low"] < seen["rate"] == seen["successes"] / 400 < seen["high"] < 1


def test_a_mistake_is_one_line(tmp_path, folder):
    with mistakes.of("RESULT", tmp_path):
        command.main([str(tmp_path)])
    files.write_json(tmp_path / "result.json", {"other": 1})
    with mistakes.of("RESULT"):
        command.main([str(tmp_path)])
    with mistakes.of("markdown", "both"):
        command.main([str(folder), "--json", "--markdown"])
