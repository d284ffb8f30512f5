"""`starjax inspect`: summarises a dataset, policy or result and its anomalies."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import tyro

from starjax.cli import checks, options
from starjax.core import errors, extensions
from starjax.core.limits import Range
from starjax.runtime import files, hub, xla

DESCRIPTION = """Summarises a dataset, policy or result and flags anomalies.

PATH is a directory of demonstrations, a dataset in a format of starjax list, a policy.safetensors
or the name of a packaged policy, a result.json or a directory with one. --page writes a page with
figures of a dataset: trocars and their wander, RCM error, reach, speed, jaws, and images of one
episode, drawn for it. --map adds the notes of an import.

Examples:
  starjax inspect runs/cpu/demos-0123456789ab
  starjax inspect their-dataset --page their-dataset.html
  starjax inspect compact"""

_SHOWN = 20  # anomalies


@dataclasses.dataclass(frozen=True)
class InspectArgs:
    """Flags of the command."""

    path: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="PATH")]
    page: str = ""  # HTML file to write, with figures of a dataset's motions
    # pixels per side of images of an episode that are drawn for --page; 0: none
    image_size: Annotated[int, Range(0, 4_096)] = 256
    map: str = ""  # mapping of another dataset, as of starjax import; empty: the one that fits


class Found(NamedTuple):
    """Summary: rows of names and texts, and one line per anomaly."""

    rows: list[tuple[str, str]]
    odd: list[str]


def main(argv: Sequence[str]) -> int:
    """Prints the summary; returns 1 if there are anomalies."""
    args = options.parse("inspect", InspectArgs, argv, DESCRIPTION)
    xla.prepare_xla()
    if args.page:
        checks.expect_folder("folder of --page", Path(args.page).parent)
    summary = inspect(args.path)
    if args.page:
        path = hub.dataset("PATH", args.path)
        if (write := extensions.hook("dataset_page")) is None:
            raise errors.UsageError("--page", "the add-on viewer", "none")
        odd = write(path, args.map, Path(args.page), summary.rows, summary.odd, args.image_size)
        summary = Found([*summary.rows, ("page", args.page)], odd)
    elif args.map:
        _, odd = extensions.hook("inspect_page")(hub.dataset("PATH", args.path), args.map)
        summary = Found(summary.rows, list(dict.fromkeys([*summary.odd, *odd])))
    width = max(len(name) for name, _ in summary.rows)
    for name, text in summary.rows:
        print(errors.printable(f"{name:{width}}  {text}".rstrip()))
    for line in summary.odd[:_SHOWN]:
        print(errors.printable(f"odd: {line}"))
    if len(summary.odd) > _SHOWN:
        print(f"odd: {len(summary.odd) - _SHOWN} more")
    return int(bool(summary.odd))


def inspect(name: str) -> Found:
    """Summarises the file or directory at a path, or the packaged policy of this name.

    Raises:
      errors.UsageError: its kind is unknown, or it cannot be read.
    """
    from starjax.policies import packaged

    is_policy = hub.is_name(name) and not hub.parse("PATH", name).is_dataset
    path = Path(name) if is_policy else hub.dataset("PATH", name)
    look: Callable[[Path], Found] | None
    if is_policy or packaged.locate(name).suffix == ".safetensors":
        path, look = packaged.find("PATH", name), _policy
    elif (path / "dataset.json").is_file():
        look = _dataset
    elif path.suffix == ".json" or (path / "result.json").is_file():
        look = _result
    elif (look := extensions.hook("inspect")) is None:
        expected = "a dataset of starjax, a policy or a result"
        raise errors.UsageError("PATH", expected, name, "others need the add-on formats")
    try:
        return look(path)
    except (ValueError, KeyError) as error:
        if isinstance(error, errors.UsageError):
            raise
        raise errors.UsageError("PATH", "a dataset, policy or result", error) from error


def _dataset(path: Path) -> Found:
    from starjax.data import anomalies, stillness, store

    about = store.read_description(path)
    scene, keys = about["scene"], store.keys(path)
    records = [
        r for r in store.verify_all(path, keys, arrays=False).values() if isinstance(r, dict)
    ]
    kept = [record for record in records if record["files"]]
    lengths = sorted(record["length"] for record in kept)
    size = sum(file["bytes"] for record in kept for file in record["files"].values())
    sealed = files.read_json(path / "SEALED.json")["digest"] if store.is_sealed(path) else "none"
    rows = [
        ("dataset", f"of starjax, schema {about['schema']}, digest {sealed[:12]}"),
        ("scene", _scene(scene)),
        ("episodes", f"{len(records)}: {sum(bool(r['success']) for r in records)} successful"),
        ("kept", f"{len(kept)}, {sum(lengths)} frames, {files.size(size)}"),
        ("lengths", spread(lengths, " control steps")),
        ("trocars", f"{len({r['trocar'] for r in kept})} used of {len(about['trocars'])}"),
        ("rests", stillness.text(stillness.of_records(path, kept))),
        ("from", "import" if "imported" in about else f"expert {about['expert']}"),
    ]
    rows += [
        (f"  {name}", f"{feature['dtype']} {feature['shape']}  {feature.get('what', '')}")
        for name, feature in about["features"].items()
    ]
    return Found(rows, list(anomalies.find(path)))


def _policy(path: Path) -> Found:
    import jax
    import numpy as np

    from starjax.policies import policy_file

    trained = policy_file.load(path)
    policy, train, leaves = trained.policy, trained.train, jax.tree.leaves(trained.params)
    count = sum(leaf.size for leaf in leaves) / 1e6
    rows = [
        ("policy", f"{trained.method}, learner {policy.learner}, preset {trained.preset}"),
        ("scene", _scene(trained.scene._asdict())),
        ("weights", f"{count:.3g} M, {files.size(path.stat().st_size)}"),
        ("observes", f"{policy.observation}, {policy.image_size} px, {policy.obs_horizon} steps"),
        ("plans", f"{policy.horizon} commands, {policy.execute} executed"),
        ("trained", f"{train.steps} steps of {train.batch_size}"),
    ]
    if monitor := trained.monitor:
        rows.append(("monitor", f"alpha {monitor.alpha:g}, {monitor.count} calibration successes"))
    odd = [] if all(np.isfinite(leaf).all() for leaf in leaves) else ["weights are not finite"]
    for name, box in (("actions", trained.normalizer.action), ("state", trained.normalizer.state)):
        if box is not None:
            low, high = np.asarray(box.low), np.asarray(box.high)
            ranges = (f"{a:.3g} to {b:.3g}" for a, b in zip(low, high))
            rows.append((name, ", ".join(ranges)))
            odd += [f"{name}: a range that is empty"] * bool((high <= low).any())
    return Found(rows, odd)


def _result(path: Path) -> Found:
    from starjax.evaluation import result

    file = path if path.suffix == ".json" else path / "result.json"
    scored = result.read(file)
    figures = scored.figures
    rows = [
        ("result", f"{scored.method}, observes {scored.observation}, schema {scored.schema}"),
        ("scene", _scene(scored.scene._asdict())),
        ("trials", str(len(scored.trials))),
        (
            "code",
            f"starjax {scored.version}, commit {scored.commit}{' (changed)' * bool(scored.dirty)}",
        ),
        ("weights", str(scored.weights)),
        ("dataset", str(scored.dataset_digest)),
    ]
    for name in ("seen", "unseen"):
        if rate := figures.get(name):
            low, high = (100 * bound for bound in rate["ci95"] or (0.0, 1.0))
            count = f"{rate['successes']}/{rate['trials']}"
            rows.append((name, f"{count}, 95% interval [{low:.0f}, {high:.0f}] %"))
    rows += [("note", line) for line in scored.about.get("warnings", [])]
    odd = ["made with code that was changed"] * bool(scored.dirty)
    odd += [f"{figures['invalid']} trials diverged"] * bool(figures.get("invalid"))
    return Found(rows, odd)


def _scene(scene: dict[str, Any]) -> str:
    robots = ", ".join(f"{arm} with {tool}" for arm, tool in zip(scene["arms"], scene["tools"]))
    return "; ".join(filter(None, [scene["task"], robots, ", ".join(scene["cameras"])]))


def spread(sizes: Sequence[int], unit: str) -> str:
    if not sizes:
        return "none"
    return f"{sizes[0]} to {sizes[-1]}{unit}, half of them up to {sizes[len(sizes) // 2]}"
