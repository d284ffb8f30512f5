"""Trained policies and runtime monitors of starjax, found by `starjax.policies.packaged`."""
