"""A task and an arm from outside of starjax, as in another package."""
