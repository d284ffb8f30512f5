"""`python -m starjax` is the console script `starjax`."""

import sys

from starjax import cli

sys.exit(cli.guard(cli.dispatch, sys.argv[1:]))
