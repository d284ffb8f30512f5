"""The noise of a policy gradient, chosen by its effect on success.

More noise explores more, but a policy that fails by its noise alone learns to bear the noise. Some
levels are therefore tried from the same starts, and the largest that leaves most successes is used.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from starjax.addons.finetune.explore import Starts

LEVELS = (0.0, 0.25, 0.5, 1.0, 2.0)  # multiples of the setting; 0 for the policy itself
LEAST = 0.85  # share of the policy's own successes that the noise may leave


def repeated(starts: Starts) -> tuple[Starts, np.ndarray]:
    """Returns starts `[N]`, each of them once per level, and the index of the level `[N]`."""
    count = len(starts.trial)
    first, level = np.divmod(np.arange(count), len(LEVELS))
    fields = type(starts.trocar)(*(np.asarray(field)[first] for field in starts.trocar))
    return Starts(fields, starts.index[first], starts.trial[first]), level


def chosen(tried: Sequence[dict[str, Any]]) -> float:
    """Returns the largest noise that leaves `LEAST` of the successes, else the smallest.

    Args:
      tried: `noise` and `rate` of success, of no noise first, then in ascending order.
    """
    own, *noisy = tried
    enough = [row["noise"] for row in noisy if row["rate"] >= LEAST * own["rate"]]
    return max(enough, default=noisy[0]["noise"])
