"""Numbers, tables and machines as text."""

from collections.abc import Sequence
from typing import Any

from starjax.report import stats

Table = list[list[str]]  # header first


def render(table: Table, names: int | None = None) -> str:
    """Renders a table as Markdown; columns after the first `names` are aligned right."""
    names = names_in(table[0]) if names is None else names
    rule = ["---"] * names + ["---:"] * (len(table[0]) - names)
    rows = [[cell.replace("|", "\\|") for cell in row] for row in [table[0], rule, *table[1:]]]
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def names_in(header: Sequence[str]) -> int:
    """Counts the first columns, which hold names."""
    return sum(title in ("Group", "Method", "Against") for title in header)


def rate(score: stats.Rate) -> str:
    """Renders a rate, e.g. `74.0 (71/96) [64.4, 81.7]`."""
    percent = [100 * x for x in (score.rate, score.low, score.high)]
    counts = f"{score.successes}/{score.trials}"
    return f"{percent[0]:.1f} ({counts}) [{percent[1]:.1f}, {percent[2]:.1f}]"


def brief(score: stats.Rate) -> str:
    """Renders a rate without its interval, e.g. `74 (71/96)`."""
    return f"{100 * score.rate:.0f} ({score.successes}/{score.trials})"


def points(difference: tuple[float, float, float]) -> str:
    """Renders a difference in percentage points, e.g. `+13.5 [-2.7, +29.9]`."""
    middle, low, high = (100 * x for x in difference)
    return f"{middle:+.1f} [{low:+.1f}, {high:+.1f}]"


def millimetres(value: float) -> str:
    """Renders mm with three decimals, or four below 0.01; below 1e-4 gives a bound."""
    return "<0.0001" if 0 < value < 1e-4 else f"{value:.4f}" if value < 0.01 else f"{value:.3f}"


def p_value(p: float) -> str:
    """Renders a p value with two digits; below 1e-4 gives a bound."""
    return "<0.0001" if p < 1e-4 else f"{p:.4f}" if p < 0.01 else f"{p:.2f}"


def fraction(score: stats.Rate) -> str:
    """Renders a rate as a phrase, e.g. `40 of 48 trials (83%)`."""
    return f"{score.successes} of {score.trials} trials ({100 * score.rate:.0f}%)"


def interval(score: stats.Rate) -> str:
    """Renders an interval, e.g. `95% interval 70-91%`."""
    return f"95% interval {100 * score.low:.0f}–{100 * score.high:.0f}%"


def duration(seconds: float) -> str:
    """Renders a duration, e.g. `42 s`, `7 min 2 s`, `3 h 12 min`."""
    if seconds < 59.95:
        return f"{seconds:.1f} s" if seconds < 10 else f"{seconds:.0f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


def hardware(about: dict[str, Any]) -> str:
    """Describes a machine, e.g. `1 x NVIDIA H200, 16 cores of Intel Xeon, 128 GB`."""
    parts = [] if about.get("backend") == "cpu" else _counted(about.get("devices") or [])
    if about.get("cpu"):
        parts.append(
            f"{about['cores']} cores of {about['cpu']}" if "cores" in about else about["cpu"]
        )
    if about.get("memory_gb"):
        parts.append(f"{about['memory_gb']:.0f} GB")
    return ", ".join(parts)


def machine(about: dict[str, Any]) -> str:
    """Describes a machine's GPUs, e.g. `1 x NVIDIA H200`; without a GPU, its cores."""
    if about.get("backend") == "cpu":
        return f"{about['cores']} cores of {about['cpu']}"
    return ", ".join(_counted(about["devices"]))


def code(commit: str | None, dirty: bool | None) -> str:
    """Returns a commit as text, e.g. `0a1b2c3d4e, with local changes`; empty if unknown."""
    return f"{commit[:10]}{', with local changes' if dirty else ''}" if commit else ""


def listing(value: Any) -> str:
    """Renders a small JSON value as a phrase."""
    if isinstance(value, dict):
        return ", ".join(f"{key} {listing(part)}" for key, part in value.items())
    if value is None:
        return "unknown"
    if isinstance(value, list):
        return ", ".join(listing(part) for part in value)
    return f"{value:g}" if isinstance(value, float) else str(value)


def sentence(phrase: str) -> str:
    """Capitalises the first letter of a phrase."""
    return phrase[:1].upper() + phrase[1:]


def _counted(devices: Sequence[str]) -> list[str]:
    return [f"{devices.count(kind)} x {kind}" for kind in dict.fromkeys(devices)]
