"""`starjax pack`: writes a trained policy in half precision."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from starjax.cli import checks, options
from starjax.core import config, errors
from starjax.core.limits import Range
from starjax.policies import packaged
from starjax.runtime import files, jax_start, xla

DESCRIPTION = """Writes a policy for inference: weights in float16, arithmetic in float32.

POLICY is a policy.safetensors, OUT the new file. Weights are rounded to 11 bits: evaluate OUT
itself (`starjax evaluate --policy OUT`). OUT.md is its model card, with the result in the folder
of POLICY.

Examples:
  starjax pack runs/cpu/stardiff/policy.safetensors half.safetensors"""


@dataclasses.dataclass(frozen=True)
class PackArgs:
    """Flags of the command."""

    # policy.safetensors, or the name of a packaged policy
    policy: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="POLICY")]
    # new file
    out: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    # scale of the initial noise; default: that of POLICY
    temperature: Annotated[float | None, Range(0.0, 1.0)] = None


def main(argv: Sequence[str]) -> int:
    """Writes the file; prints its size."""
    args = options.parse("pack", PackArgs, argv, DESCRIPTION)
    source, out = packaged.find("POLICY", args.policy), Path(args.out)
    checks.expect_folder("folder of OUT", out.parent)
    if out.exists():
        raise errors.UsageError("OUT", "a new file", f"{args.out or 'none'}, which exists")
    xla.prepare_xla()
    jax_start.require_devices("starjax.policies.policy_file")

    import jax

    from starjax.cli import model_card
    from starjax.policies import policy_file

    try:
        trained = policy_file.load(source)
    except ValueError as error:
        raise errors.UsageError("POLICY", "a policy of starjax", error) from error
    policy = config.inference_settings(trained.policy)
    if args.temperature is not None:
        if not hasattr(policy.options, "temperature"):
            raise errors.UsageError("POLICY", "one with a temperature", f"one of {policy.learner}")
        policy = config.with_options(policy, temperature=args.temperature)
    if trained.monitor and policy.options != trained.policy.options:
        trained = trained._replace(monitor=None)  # it was calibrated with other samples
        print("without the monitor: starjax calibrate makes one for this temperature")
    try:
        policy_file.save(out, trained._replace(policy=policy), half=True)
    except ValueError as error:
        raise errors.UsageError("POLICY", "weights that fit float16", error) from error
    card = model_card.text(out.stem, trained, model_card.find_result(source))
    files.write_bytes(out.with_suffix(".md"), card.encode())
    count = sum(leaf.size for leaf in jax.tree.leaves(trained.params)) / 1e6
    before, after = (files.size(path.stat().st_size) for path in (source, out))
    print(f"{out}: {count:.3g} M parameters, {after} ({source}: {before})")
    temperature = getattr(policy.options, "temperature", None)
    parts = [] if temperature is None else [f"temperature {temperature:g}"]
    print(", ".join([*parts, f"arithmetic in {policy.dtype}"]))
    return 0
