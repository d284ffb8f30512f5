"""What a program may make jax refuse, to find its own mistakes."""

import contextlib

import jax

STRICT = {
    "jax_array_garbage_collection_guard": "log",
    "jax_check_static_indices": True,
    "jax_check_tracer_leaks": True,
    "jax_debug_infs": True,
    "jax_debug_key_reuse": True,
    "jax_debug_nans": True,
    "jax_disallow_mesh_context_manager": True,
    "jax_enable_checks": True,
    "jax_error_checking_behavior_divide": "raise",
    "jax_error_checking_behavior_nan": "raise",
    "jax_error_checking_behavior_oob": "raise",
    "jax_explicit_x64_dtypes": "error",
    "jax_legacy_prng_key": "error",
    "jax_numpy_dtype_promotion": "strict",
    "jax_numpy_rank_promotion": "raise",
    "jax_thread_guard": True,
    "jax_transfer_guard": "disallow",
}


@contextlib.contextmanager
def mode(settings):
    """Sets settings of jax inside the block."""
    guards = [name for name in jax.config.values if "transfer_guard" in name]
    before = {name: jax.config.values[name] for name in {*settings, *guards}}
    try:
        for name, value in settings.items():
            jax.config.update(name, value)
        yield
    finally:
        for name, value in before.items():
            jax.config.update(name, value)
