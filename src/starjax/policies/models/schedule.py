"""The squared-cosine noise schedule and the time steps that DDIM visits.

Indices are zero-based: `k = 0` is the paper's k = 1 (least noise), `k = K - 1` its k = K. Tables
are computed in float64 and rounded once: at `k = 99`, 1 - beta is 1e-3 and sqrt(alpha_bar) 4.9e-4,
where a float32 running product has lost its last digits.
"""

import math
from typing import NamedTuple

import numpy as np


class Schedule(NamedTuple):
    """Tables over the diffusion steps, all float32 `[K]`.

    Attributes:
      beta: variance added at step k (Eq. 6).
      sqrt_alpha_bar: scale of the clean action after step k (Eq. 7).
      sqrt_one_minus_alpha_bar: standard deviation of the noise after step k.
    """

    beta: np.ndarray
    sqrt_alpha_bar: np.ndarray
    sqrt_one_minus_alpha_bar: np.ndarray

    @property
    def steps(self) -> int:
        """K, the number of diffusion steps."""
        return self.beta.shape[0]


class DdimTable(NamedTuple):
    """Coefficients of the n DDIM steps, in the order in which they run, `[n]` each.

    Attributes:
      k: int32 diffusion step whose noise is predicted, descending.
      sqrt_alpha_bar: at k.
      sqrt_one_minus_alpha_bar: at k.
      sqrt_alpha_bar_next: after the step; 1 for the last.
      sqrt_one_minus_alpha_bar_next: after the step; 0 for the last.
    """

    k: np.ndarray
    sqrt_alpha_bar: np.ndarray
    sqrt_one_minus_alpha_bar: np.ndarray
    sqrt_alpha_bar_next: np.ndarray
    sqrt_one_minus_alpha_bar_next: np.ndarray


def cosine(steps: int = 100) -> Schedule:
    """Makes the schedule of K steps alpha_bar(t) = cos^2((t + 0.008) / 1.008 * pi / 2).

    Each beta is capped at 0.999, as the paper's reference and Diffusion Policy do.
    """
    beta, alpha_bar = _beta_and_alpha_bar(steps)
    tables = beta, np.sqrt(alpha_bar), np.sqrt(1.0 - alpha_bar)
    return Schedule(*(table.astype(np.float32) for table in tables))


def ddim_table(diffusion_steps: int, steps: int) -> DdimTable:
    """Returns a table of `steps` DDIM steps, spread over a `cosine(diffusion_steps)` schedule.

    With 100 and 10 they are k = 90, 80, .., 0, the 'leading' spacing, which starts in the middle
    of the schedule where `steps` is no divisor: k = 50, .. for 51 of 100 instead of 98, .. .
    One step alone is k = 0, where the input counts as nearly clean: the output is the input noise,
    of use for measuring time only.
    """
    if not 1 <= steps <= diffusion_steps:
        raise ValueError(f"steps: expected 1..{diffusion_steps} (the diffusion steps), got {steps}")
    _, alpha_bar = _beta_and_alpha_bar(diffusion_steps)
    k = np.arange(steps)[::-1] * diffusion_steps // steps  # e.g. 90, 80, .., 0
    following = np.append(alpha_bar[k[1:]], 1.0)  # abar = 1 after the last step: no noise left
    tables = (alpha_bar[k], 1.0 - alpha_bar[k], following, 1.0 - following)
    return DdimTable(k.astype(np.int32), *(np.sqrt(table).astype(np.float32) for table in tables))


def _beta_and_alpha_bar(steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns float64 `[K]` each."""
    if steps < 1:
        raise ValueError(f"steps: expected at least 1 diffusion step, got {steps}")
    # abar(t) at the K + 1 ends of the steps; beta_k = 1 - abar(k + 1) / abar(k).
    cosines = np.cos((np.arange(steps + 1) / steps + 0.008) / 1.008 * math.pi / 2) ** 2
    beta = np.minimum(1.0 - cosines[1:] / cosines[:-1], 0.999)
    return beta, np.cumprod(1.0 - beta)  # abar_k = prod (1 - beta_i), with the cap in it
