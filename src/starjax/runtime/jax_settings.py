"""Settings of jax that change results or end programs, and their treatment.

Shells set them for other projects. Commands set those of `FIXED` (random numbers and types) and
`CHECKS` (which raise errors) to jax's defaults. Those of `RECORDED` and XLA's flags stay
the user's: `recorded` lists the ones that differ from the defaults, and saved trials and
demonstrations are used again only if all of these agree.

`deploy` and `rcm`, used in programs of others, set nothing; `recorded` then lists `FIXED` too.
"""

import os
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import jax

from starjax.runtime import xla

# Random numbers and types, set by commands to jax's defaults: all published results have them.
FIXED: Mapping[str, Any] = MappingProxyType({
    "jax_default_prng_impl": "threefry2x32",  # under `vmap` a number depends on its own key alone
    "jax_disable_jit": False,
    "jax_enable_custom_prng": False,
    "jax_enable_x64": False,
    "jax_explicit_x64_dtypes": "warn",
    "jax_high_dynamic_range_gumbel": False,
    "jax_random_seed_offset": 0,
    "jax_threefry_gpu_kernel_lowering": False,
    "jax_threefry_partitionable": True,
})  # fmt: skip

# Checks and guards, set by commands to jax's defaults: an alarm of theirs would end the command.
CHECKS: Mapping[str, Any] = MappingProxyType({
    "jax_array_garbage_collection_guard": None,
    "jax_check_static_indices": False,
    "jax_check_tracer_leaks": False,
    "jax_compilation_cache_check_contents": False,
    "jax_debug_infs": False,
    "jax_debug_key_reuse": False,
    "jax_debug_nans": False,
    "jax_disallow_mesh_context_manager": False,
    "jax_enable_checks": False,
    "jax_error_checking_behavior_divide": "ignore",
    "jax_error_checking_behavior_nan": "ignore",
    "jax_error_checking_behavior_oob": "ignore",
    "jax_legacy_prng_key": "allow",
    "jax_mutable_array_checks": True,
    "jax_no_execution": False,
    "jax_no_tracing": False,
    "jax_numpy_dtype_promotion": "standard",
    "jax_numpy_rank_promotion": "allow",
    "jax_raise_persistent_cache_errors": False,
    "jax_thread_guard": False,
    "jax_transfer_guard": None,
    "jax_transfer_guard_device_to_device": None,
    "jax_transfer_guard_device_to_host": None,
    "jax_transfer_guard_host_to_device": None,
})  # fmt: skip

# Left to the user, and recorded unless they are jax's defaults: precision and optimisation, which
# change the last bits of sums.
RECORDED: Mapping[str, Any] = MappingProxyType({
    "jax_allow_f16_reductions": True,
    "jax_compiler_enable_remat_pass": True,
    "jax_default_matmul_precision": None,
    "jax_disable_most_optimizations": False,
    "jax_exec_time_optimization_effort": 0.0,
    "jax_optimization_level": "UNKNOWN",
    "jax_softmax_custom_jvp": False,
    "jax_use_shardy_partitioner": True,
})  # fmt: skip

# Variables of the environment that XLA reads flags from, and one of NVIDIA's libraries.
_FLAGS = ("XLA_FLAGS", "LIBTPU_INIT_ARGS")
_TF32 = "NVIDIA_TF32_OVERRIDE"
_FREE_FLAGS = ("--xla_dump_", "--xla_force_host_platform_device_count", "--xla_gpu_cuda_data_dir")


def fix() -> list[str]:
    """Sets all of `FIXED` and `CHECKS`; returns the names of those that had another value."""
    defaults = {**FIXED, **CHECKS}
    others = [name for name in defaults if _differs(name, defaults[name])]
    for name in others:
        jax.config.update(name, defaults[name])
    return others


def recorded() -> dict[str, str]:
    """Returns settings that change random numbers or arithmetic and are not the usual ones.

    Returns:
      name of the setting -> its value; empty where all is as usual, as `xla.prepare_xla` leaves it.
    """
    defaults = {**FIXED, **RECORDED}
    names = [name for name in defaults if _differs(name, defaults[name])]
    values = {name: str(_plain(_value(name))) for name in names}
    ours = xla.usual_flags()
    for name, value in sorted({**dict.fromkeys(ours, "unset"), **_flags()}.items()):
        if not name.startswith(_FREE_FLAGS) and ours.get(name) != value:
            values[name] = value
    if _TF32 in os.environ:
        values[_TF32] = os.environ[_TF32]
    return values


def record() -> dict[str, dict[str, str]]:
    """Returns `recorded` as an entry of a JSON object; no entry where all is as usual."""
    values = recorded()
    return {"jax_settings": values} if values else {}


def _flags() -> dict[str, str]:
    """Returns XLA's flags in the environment by name, of which the last of each name counts."""
    words = (word.partition("=") for text in map(xla.flags, _FLAGS) for word in text.split())
    return {name: value.lower() if equals else "true" for name, equals, value in words}


def _differs(name: str, default: str | bool | float | None) -> bool:
    return name in jax.config.values and _plain(_value(name)) != default


def _value(name: str) -> Any:
    """Returns the value of a setting in this thread, where a context may have changed it."""
    return getattr(jax.config, name, jax.config.values[name])


def _plain(value: Any) -> Any:
    """Returns a member of one of jax's enumerations as the word that sets it."""
    return value.name.lower() if hasattr(value, "name") else value
