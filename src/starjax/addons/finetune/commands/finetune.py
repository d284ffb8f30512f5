"""`starjax finetune`: a trained policy improves in the simulator."""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path

from starjax.addons.finetune import settings
from starjax.cli import checks, options, policy_args, session
from starjax.core import errors

DESCRIPTION = """Improves a trained policy in the simulator and writes policy.safetensors.

RUN is the directory of a method, such as runs/cpu/stardiff; --policy takes a policy.safetensors or
the name of a packaged policy instead. Every round runs the policy through the seen trocars, adds
chosen episodes to the demonstrations, and continues the training of the policy's weights; rl and
distill train a policy of the learner onestep from decisions of all episodes. The round that is best
on separate trials is kept, the policy itself if no round is better. Rerun the same command to
resume.

Examples:
  starjax finetune runs/cpu/stardiff --by dagger
  starjax finetune --policy compact --rounds 1
  starjax finetune runs/onestep/stardiff --by rl"""


@dataclasses.dataclass(frozen=True, kw_only=True)
class FinetuneArgs(settings.FinetuneConfig):
    """Flags of the command."""

    run: options.RunOrNone = ""  # directory of a method, such as runs/cpu/stardiff
    policy: str = ""  # policy.safetensors or name of a packaged policy, instead of RUN
    out: str = options.AUTO  # directory of the results; auto: one in RUN or in runs/finetune


def main(argv: Sequence[str]) -> int:
    """Runs the missing rounds; writes policy.safetensors and finetune.json."""
    args, path, folder = session.for_device(
        functools.partial(_parse, argv), *session.RUN_MODULES, *session.POLICY_MODULES
    )
    started = session.start("finetune", argv, folder)
    from starjax.addons.finetune.commands import finetuning

    with started.shared() as share:
        finetuning.run(args, path, started, share)
    return 0


def _parse(argv: Sequence[str], has_gpu: bool) -> tuple[FinetuneArgs, policy_args.PolicyPath, Path]:
    """Returns the flags, the policy's file and the directory of the results."""
    values = settings.FinetuneConfig() if has_gpu else settings.ON_CPU
    default = FinetuneArgs(**vars(values))
    args = options.parse("finetune", FinetuneArgs, argv, DESCRIPTION, default)
    if args.policy.startswith(policy_args.SCHEMES):
        raise errors.UsageError("--policy", "a file or a packaged policy", args.policy)
    path = policy_args.resolve(policy_args.PolicyArgs(run=args.run, policy=args.policy))
    folder = path.folder("finetune", [args.by, f"seed{args.seed}"], args.out)
    checks.expect_folder("--out", folder)
    return args, path, folder
