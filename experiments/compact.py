"""Moves the trials of results into compressed files next to them, the form kept here.

python experiments/compact.py RESULT.json...
"""

import sys
from pathlib import Path

from starjax.evaluation import trial_file

if __name__ == "__main__":
    for name in sys.argv[1:]:
        trial_file.detach(Path(name))
