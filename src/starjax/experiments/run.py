"""The main command, `python -m starjax.experiments.run`: the same as `starjax run`."""

from starjax import cli

if __name__ == "__main__":
    cli.run(lambda argv: cli.dispatch(["run", *argv]))
