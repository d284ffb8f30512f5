"""Which scene a benchmark simulates: its flags, its environment, and its name in results."""

import argparse
from typing import Any

from starjax.sim import env as envs
from starjax.sim import names, scene


def add_flags(parser: argparse.ArgumentParser) -> None:
    """`--task`, `--arm` and `--tool`."""
    parser.add_argument("--task", default="peg_transfer", help="of the registry")
    parser.add_argument("--arm", nargs="+", default=[], help="one per slot, or one for all")
    parser.add_argument("--tool", nargs="+", default=[], help="one per slot, or one for all")


def make(asked: argparse.Namespace, **settings: Any) -> envs.Env:
    """The environment of the flags; `settings` are those of `env.make`."""
    return envs.make(asked.task, asked.arm, asked.tool, **settings)


def result_name(benchmark: str, found: names.SceneNames) -> str:
    """Name of a benchmark's result file; other scenes than the usual one have their own."""
    if found == scene.name():
        return benchmark
    tools = () if found.tools == scene.name(found.task, found.arms).tools else found.tools
    return "_".join([benchmark, found.task, *found.arms, *tools])
