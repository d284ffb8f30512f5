"""Settings and fixtures of every test: XLA is set up here, before anything imports jax."""

import os

from starjax import runtime

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("MPLBACKEND", "Agg")
runtime.prepare_xla()
