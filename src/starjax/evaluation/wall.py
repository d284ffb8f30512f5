"""The force that a tool's shaft puts on the abdominal wall at its trocar.

The wall is a spring with a damper between the trocar's centre and the point of the shaft nearest to
it. The force is computed from the executed RCM error alone: the wall does not push back on the
simulated arm, whose servos are far stiffer.
"""

from typing import Any

import numpy as np

from starjax.evaluation import trials as tables

# Assumed, not measured: walls differ by their thickness and by the pressure of the gas. Forces are
# proportional to both.
STIFFNESS = 1000.0  # N/m
DAMPING = 10.0  # N s/m


def force(table: tables.Table, control_hz: float) -> dict[str, Any]:
    """Computes mean, 99th percentile and maximum, in N, over all control steps of all trials.

    The damper acts on the rate of the RCM error; motion around the trocar at constant distance
    loads the spring alone.
    """
    found = []
    for error in np.split(table.rcm_error_mm.astype(np.float64), np.cumsum(table.steps)[:-1]):
        speed = np.diff(1e-3 * error, prepend=1e-3 * error[:1]) * control_hz
        found.append(np.abs(STIFFNESS * 1e-3 * error + DAMPING * speed))
    force_N = np.concatenate(found)
    if not force_N.size:
        return {"mean": None, "p99": None, "max": None}
    mean, most = float(force_N.mean()), float(force_N.max())
    return {"mean": mean, "p99": float(np.quantile(force_N, 0.99)), "max": most}
