"""Experts that finish an episode which another agent began."""
