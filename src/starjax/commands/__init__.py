"""The commands: one module each, named in `starjax.cli`."""
