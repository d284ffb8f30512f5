"""Files of a run: reading, matching, damage."""

import json
import re

import numpy as np
import pytest
import synthetic
from report.conftest import edited

from starjax.evaluation import paired
from starjax.report import compare, results
from starjax.runtime import files


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("result.json", b'{"method": "stardiff"'),
        ("sweep.json", b'{"trials": ['),
        ("bench.json", b"{}"),
        ("metrics.jsonl", b'{"step": 1\n{"step": 2}\n'),
        ("metrics.jsonl", b"5\n"),
        ("evaluation/recorded.npz", b"PK"),
    ],
)
def test_a_damaged_file_of_a_run_is_named(one, tmp_path, name, content):
    (tmp_path / "evaluation").mkdir()
    (tmp_path / "result.json").write_bytes((one.path / "result.json").read_bytes())
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=re.escape(str(tmp_path / name))):
        results.load(tmp_path)


def test_a_trajectory_is_shown_with_its_own_trial_or_not_at_all(tmp_path):
    run = synthetic.run(tmp_path / "stardiff")
    file = run / "evaluation" / "recorded.npz"
    kept = files.read_npz(file)
    count, longest = kept["p_world_tip"].shape[:2]
    kept["qpos"] = np.broadcast_to(np.arange(count)[:, None, None], (count, longest, 2))
    files.write_npz(file, kept)
    shown = results.load(run).rollouts
    assert len(shown) == count == 36
    for row, rollout in enumerate(shown):
        assert rollout.p_world_tip.shape == (rollout.trial.steps, 1, 3)
        assert (rollout.qpos == row).all() and len(rollout.qpos) == rollout.trial.steps
        assert rollout.labels.items() <= rollout.trial.labels.items()
    # After a kill some are of another evaluation.
    result = files.read_json(run / "result.json")
    told = [paired.identity(rollout.trial) for rollout in shown[:2]]
    for trial in result["trials"]:
        met = (trial["trocar"], trial["trial"], trial["seed"])
        trial["steps"] += met == told[0]
        trial["rcm_max_mm"] *= 1.001 if met == told[1] else 1
    files.write_json(run / "result.json", result)
    assert len(results.load(run).rollouts) == count - 2


def test_what_other_weights_left_beside_a_result_is_not_shown(tmp_path):
    run = synthetic.run(tmp_path / "stardiff", sweep_of=5)
    bare, swept = (files.read_json(run / name) for name in ("result.json", "sweep.json"))
    ms = {"p50": 1.0, "p95": 1.0, "p99": 1.0}
    bench = {"weights": "a", "inference_ms_by_ddim_steps": {"2": ms}}
    files.write_json(run / "bench.json", bench)
    files.write_json(run / "sweep.json", {**swept, "weights": "a"})
    for weights in ("a", None, "b"):  # once neither file said it
        files.write_json(run / "result.json", {**bare, "weights": weights})
        found = results.load(run)
        assert bool(found.sweep) == bool(found.bench) == (weights != "b")
    assert found.others == ("sweep.json", "bench.json")


def test_curves_are_of_the_runs_own_training(one, tmp_path):
    content = (one.path / "result.json").read_bytes()
    for name in ("stardiff", "packaged"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "result.json").write_bytes(content)
    log = tmp_path / "stardiff" / "metrics.jsonl"
    log.write_text('{"step": 1}\n{"step": 2')  # a kill cut the last line short
    assert results.load(tmp_path / "packaged").curves == []
    assert results.load(tmp_path / "stardiff").curves == [{"step": 1}]
    trained = {**one.result.config, "train": {**one.result.config["train"], "steps": 7}}
    files.write_json(tmp_path / "stardiff" / "config.json", trained)
    run = results.load(tmp_path / "stardiff")
    assert run.curves == [] and run.others == ("metrics.jsonl",)
    files.write_json(tmp_path / "stardiff" / "config.json", one.result.config)
    other = json.loads(content) | {"method": "stardiff_single"}
    files.write_json(tmp_path / "stardiff_single" / "result.json", other)
    (tmp_path / "stardiff").rename(tmp_path / "dp_rcm4")  # whose weights it shares
    assert results.load(tmp_path / "stardiff_single").curves == [{"step": 1}]


def test_figures_prefer_the_trials_that_stardiff_met(several):
    single = several[2]._replace(group="one")
    others = [edited(run._replace(group="two"), seed=seed) for run, seed in zip(several, (4, 5))]
    for seed, best in zip((4, 5), others, strict=True):
        assert compare.representatives([*others, edited(single, seed=seed)])[0] is best


def test_results_of_two_tasks_or_of_an_unknown_one_are_no_report(one):
    other = edited(one, scene=one.result.scene._replace(task="needle"))
    for runs in ([one, other], [other]):
        with pytest.raises(ValueError, match="needle"):
            compare.task(runs)
