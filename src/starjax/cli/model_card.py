"""Model card of a policy, from its file and the result of its evaluation; no text by hand.

The header is YAML that model hubs read.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from starjax.core import config
from starjax.policies.policy_file import Trained
from starjax.report import formats, stats

LIMITS = """\
- Trained and evaluated in simulation, on demonstrations of a scripted expert. Not for use on a
  patient.
- Other trocars, arms, instruments, cameras and looks of the scene than those above were not part of
  these trials.
- Rates are of one training. An interval covers the trials, not other trainings."""


def find_result(policy: Path) -> dict[str, Any]:
    """Returns the result in the folder of a policy, of its run or package; empty without one."""
    for file in (policy.with_suffix(".json"), policy.with_name("result.json")):
        if file.is_file():
            return json.loads(file.read_text())
    return {}


def text(name: str, trained: Trained, result: Mapping[str, Any]) -> str:
    """Returns the card in Markdown.

    Args:
      name: of the policy, its title.
      trained: of its file; parameters are not read.
      result: values of a `result.json`, empty if the policy was not evaluated.
    """
    scene, policy = trained.scene, trained.policy
    tags = ["robotics", "imitation-learning", "surgical-robotics", scene.task]
    header = ["license: apache-2.0", "library_name: starjax", "pipeline_tag: robotics", "tags:"]
    demos = trained.demos
    rows = {
        "task": f"`{scene.task}`",
        "arms": _listed(scene.arms),
        "instruments": _listed(scene.tools),
        "cameras": _listed(scene.cameras) if policy.observation == "image" else "none",
        "method, learner": f"`{trained.method}`, `{policy.learner}`",
        "demonstrations": "unknown" if demos is None else _demonstrations(demos),
        "training": f"{trained.train.steps:,} steps of {trained.train.batch_size}",
        "dataset": result.get("dataset_digest", ""),
    }
    return "\n".join(
        [
            *("---", *header, *(f"- {tag}" for tag in tags), "---", ""),
            *(f"# {name}", "", "A policy of starjax: `starjax evaluate --policy PATH`.", ""),
            *(_facts(rows), ""),
            *("## Evaluation", "", *(_evaluation(result) if result else ["None recorded."]), ""),
            *("## Limits", "", LIMITS, ""),
        ]
    )


def _listed(names: Sequence[str]) -> str:
    return ", ".join(f"`{name}`" for name in names) or "none"


def _demonstrations(demos: config.DemosConfig) -> str:
    expert = f", expert `{demos.expert}`" if demos.expert else ""
    return f"{demos.per_trocar} at each of {demos.seen_trocars} seen trocars{expert}"


def _facts(rows: Mapping[str, str]) -> str:
    table = [["", ""], *([name, value or "not recorded"] for name, value in rows.items())]
    return formats.render(table, names=2)


def _evaluation(result: Mapping[str, Any]) -> list[str]:
    scores = {
        "all seen": result["strict"]["seen"],
        "all unseen": result["strict"]["unseen"],
        **{
            f"{row['trocar']}, {'seen' if row['seen'] else 'unseen'}": row
            for row in result["per_trocar"]
        },
    }
    table = [
        [name, formats.rate(stats.rate(score["successes"], score["trials"]))]
        for name, score in scores.items()
        if score["trials"]
    ]
    executed = result["rcm_error_mm"]["executed"]
    rows = {
        "RCM error executed": f"mean {formats.millimetres(executed['mean'])} mm, 99th percentile "
        f"{formats.millimetres(executed['p99'])} mm",
        "time of a decision": f"{result['inference_ms']['p50']:.1f} ms, median",
        "command": f"`{result['command']}`",
        "seed of the training": formats.listing(result["config"].get("seed")),
        "seed of the trials": formats.listing(result.get("seed")),
        "commit": formats.code(result.get("commit"), result.get("dirty")),
        "versions": formats.listing(result["versions"]),
        "machine": formats.hardware(result["hardware"]),
    }
    return [
        "Strict success in percent, with 95% Wilson intervals.",
        "",
        formats.render([["Trocar", "Success"], *table], names=1),
        "",
        _facts(rows),
    ]
