"""A runtime monitor: scores of plans and poses, one conformal threshold, alarms in closed loop."""
