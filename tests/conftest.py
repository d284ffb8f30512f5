"""Settings and fixtures of every test: XLA is set up here, before anything imports jax."""

import os

from starjax import runtime

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("MPLBACKEND", "Agg")
# Most programs here run once: compiling them takes longer than running them.
_QUICK = "--xla_backend_optimization_level=0"
if _QUICK.partition("=")[0] not in os.environ.get("XLA_FLAGS", ""):
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {_QUICK}".strip()
runtime.prepare_xla()
