"""Rate of success around each place of a plane, from the trials near it."""

import functools

import numpy as np

WIDTH = 0.008  # m, standard deviation of a trial's weight
FAR = 2.0  # standard deviations from the nearest trial, beyond which there is no rate


def around(
    x: np.ndarray, y: np.ndarray, at: np.ndarray, rates: np.ndarray, weights: np.ndarray
) -> np.ndarray:
    """Returns kernel means of rates, NaN farther than `FAR` from all of them.

    Args:
      x, y: `[W]` and `[H]` m, the grid.
      at: `[N, 2]` m.
      rates, weights: `[N]`, e.g. means and numbers of trials.

    Returns:
      `[H, W]`.
    """
    # A normal distribution is a product: `[W, N]` and `[H, N]` stand for `[H, W, N]`.
    squares = [((axis[:, None] - at[:, i]) / WIDTH) ** 2 for i, axis in enumerate((x, y))]
    across, along = (np.exp(-0.5 * square) for square in squares)
    total = (along * weights) @ across.T
    mean = (along * weights * rates) @ across.T / np.maximum(total, 1e-12)
    off = (down[:, None] + right for down, right in zip(squares[1].T, squares[0].T))
    nearest = functools.reduce(np.minimum, off)
    return np.where(nearest > FAR**2, np.nan, mean)
