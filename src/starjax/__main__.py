"""`python -m starjax` is the console script `starjax`."""

from starjax import cli

cli.main()
