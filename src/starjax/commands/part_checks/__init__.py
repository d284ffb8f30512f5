"""Checks of one part each, a module per kind: generators of `base.Check`, in the order of work."""
