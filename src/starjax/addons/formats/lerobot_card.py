"""README of an exported dataset for hubs: content and origin."""

from typing import Any

from starjax.addons.formats.base import Source

_HEADER = """---
license: unknown
task_categories:
- robotics
tags:
- LeRobot
- surgical-robotics
- starjax
configs:
- config_name: default
  data_files: data/*/*.parquet
---
"""


def card(info: dict[str, Any], source: Source) -> str:
    """Returns the card's text.

    Args:
      info: content of meta/info.json.
      source: the written dataset.
    """
    origin = source.origin or {}
    about = origin.get("description", {})
    rows = [
        ("task", source.task),
        ("robot", info["robot_type"]),
        ("episodes", info["total_episodes"]),
        ("frames", f"{info['total_frames']} at {info['fps']} Hz"),
        ("trocars", len(about.get("trocars", [])) or "not said"),
        (
            "code",
            f"starjax {origin.get('version', '')}, commit {origin.get('commit') or 'unknown'}",
        ),
        ("dataset", f"`{origin['digest']}`" if origin else "not said"),
    ]
    features = [
        f"| `{name}` | {feature['dtype']} | {feature['shape']} | {_names(feature)} |"
        for name, feature in info["features"].items()
        if not name.startswith("starjax.")
    ]
    return "\n".join(
        [
            _HEADER,
            f"# {source.task}\n",
            "Demonstrations of a laparoscopic tool that moves through a trocar. Lengths are in m, "
            "the world's frame has z up, quaternions are xyzw; z of the tip's frame is the shaft, "
            "away from the robot. The gripper is -1 closed to +1 open.\n",
            "| | |\n|---|---|",
            *(f"| {name} | {text} |" for name, text in rows),
            "\n## Features\n\n| name | type | shape | numbers |\n|---|---|---|---|",
            *features,
            f"\n{_for_readers(info)}\n",
            "\n`observation.trocar` is where the shaft passes through the wall: a remote centre of "
            "motion, fixed within an episode. Columns `starjax.*` and `meta/starjax.json` bring "
            "the dataset back as it was: `starjax import`.\n",
        ]
    )


def _for_readers(info: dict[str, Any]) -> str:
    """Returns a line about policies that read the state alone."""
    names = info["features"].get("observation.state", {}).get("names") or []
    reads = "LeRobot's ACT and diffusion read `observation.state` and the images, "
    if any("trocar" in str(name) for name in names):
        return f"{reads}so the state ends with the trocar."
    return (
        f"{reads}and never `observation.trocar`: a policy that should be conditioned on the trocar "
        "needs an export with `--state-with-trocar`."
    )


def _names(feature: dict[str, Any]) -> str:
    names = feature.get("names") or []
    return ", ".join(map(str, names)) if len(names) < 30 else f"{names[0]} ... {names[-1]}"
