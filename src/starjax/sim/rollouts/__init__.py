"""Closed-loop rollouts of any agent: the loop, its devices, missing parts."""
