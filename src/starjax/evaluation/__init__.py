"""Closed-loop evaluation of a trained policy: rollouts, statistics, sweeps."""
