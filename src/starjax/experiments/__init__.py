"""Home of `python -m starjax.experiments.run`; the commands live in `starjax.cli`."""
