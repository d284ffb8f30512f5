"""Model card of a policy, from its file and the result of its evaluation; no text by hand.

The header is YAML that model hubs read.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from starjax.policies.policy_file import Trained

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
        "dataset": result.get("dataset_digest") or "not recorded",
    }
    return "\n".join(
        [
            *("---", *header, *(f"- {tag}" for tag in tags), "---", ""),
            *(f"# {name}", "", "A policy of starjax: `starjax evaluate --policy PATH`.", ""),
            *("| | |", "|---|---|", *(f"| {key} | {value} |" for key, value in rows.items()), ""),
            *("## Evaluation", "", *(_evaluation(result) if result else ["None recorded."]), ""),
            *("## Limits", "", LIMITS, ""),
        ]
    )


def _listed(names: Any) -> str:
    return ", ".join(f"`{name}`" for name in names) or "none"


def _demonstrations(demos: Any) -> str:
    expert = f", expert `{demos.expert}`" if demos.expert else ""
    return f"{demos.per_trocar} at each of {demos.seen_trocars} seen trocars{expert}"


def _evaluation(result: Mapping[str, Any]) -> list[str]:
    rates = {
        "seen trocars": result["strict"]["seen"],
        "unseen trocars": result["strict"]["unseen"],
        **{_trocar(row): row for row in result["per_trocar"]},
    }
    provenance = {
        "command": f"`{result['command']}`",
        "seeds of training, trials": f"{result['config'].get('seed', 'not recorded')}, "
        f"{result.get('seed', 'not recorded')}",
        "commit": result.get("commit") or "not recorded",
        "versions": ", ".join(f"{k} {v}" for k, v in result["versions"].items() if "jax" in k),
        "device": ", ".join(result["hardware"]["devices"]),
    }
    return [
        "Strict success, with 95% Wilson intervals.",
        "",
        "| Trials at | successes | rate |",
        "|---|---:|---:|",
        *(f"| {name} | {row['successes']}/{row['trials']} | {_rate(row)} |"
          for name, row in rates.items() if row["trials"]),
        "",
        f"RCM error executed: mean {result['rcm_error_mm']['executed']['mean']:.3f} mm, "
        f"99th percentile {result['rcm_error_mm']['executed']['p99']:.3f} mm. "
        f"A decision takes {result['inference_ms']['p50']:.1f} ms (median).",
        "",
        "| | |",
        "|---|---|",
        *(f"| {key} | {value} |" for key, value in provenance.items()),
    ]  # fmt: skip


def _trocar(row: Mapping[str, Any]) -> str:
    return f"trocar {row['trocar']}, {'seen' if row['seen'] else 'unseen'}"


def _rate(row: Mapping[str, Any]) -> str:
    low, high = row["ci95"]
    return f"{100 * row['rate']:.1f}% ({100 * low:.1f}–{100 * high:.1f})"
