"""Every setting of jax, and what is done about it: the one list of them.

A setting can change random numbers (JAX_THREEFRY_PARTITIONABLE), arithmetic (JAX_ENABLE_X64), what
is an error (JAX_DEBUG_NANS), or none of these (JAX_LOG_COMPILES). Shells set them for other
projects. So a command sets those of `FIXED` and `CHECKS` itself. Those of `RECORDED`, and XLA's
flags, stay the user's: where they are not the usual ones, `recorded` tells, and saved trials and
demonstrations are used again only where all it tells agrees.

In a program of somebody else's, `deploy` and `rcm` set nothing; there `recorded` tells of `FIXED`
too.
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

# Checks and guards, set by commands to jax's defaults: what they find would end the command.
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

# Left to the user, and recorded where it is not jax's default: precision, and what decides which
# program is compiled, of which the last bits of a sum may be others.
RECORDED: Mapping[str, Any] = MappingProxyType({
    "eager_constant_folding": False,
    "jax_allow_f16_reductions": True,
    "jax_bcoo_cusparse_lowering": False,
    "jax_compilation_cache_expect_pgle": False,
    "jax_compiler_enable_remat_pass": True,
    "jax_cpu_collectives_implementation": "gloo",
    "jax_custom_jvp3": False,
    "jax_custom_vjp3": False,
    "jax_default_matmul_precision": None,
    "jax_disable_most_optimizations": False,
    "jax_enable_pgle": False,
    "jax_exec_time_optimization_effort": 0.0,
    "jax_memory_fitting_effort": 0.0,
    "jax_memory_fitting_level": "O2",
    "jax_mock_gpu_topology": "",
    "jax_mosaic_allow_hlo": False,
    "jax_optimization_level": "UNKNOWN",
    "jax_pallas_poison_buffers": False,
    "jax_pallas_use_mosaic_gpu": True,
    "jax_pjrt_client_create_options": None,
    "jax_ragged_dot_use_gpu_pallas_triton_lowering": False,
    "jax_ragged_dot_use_ragged_dot_instruction": True,
    "jax_remat3": False,
    "jax_remat_barrier_no_cotangents": False,
    "jax_scan3": False,
    "jax_softmax_custom_jvp": False,
    "jax_use_direct_linearize": True,
    "jax_use_emit_pipeline_primitive": False,
    "jax_use_hlo_logistic_lowering": None,
    "jax_use_magma": "auto",
    "jax_use_shardy_partitioner": True,
    "jax_xla_profile_version": 0,
    "mock_num_gpu_processes": 0,
})  # fmt: skip

# They change no number: devices (`hardware` tells them), caches, logs, dumps, error messages,
# connections, `jax.export`, `jax2tf`, and checks of a program's types while it is traced.
FREE = frozenset({
    "check_vma", "jax2tf_associative_scan_reductions", "jax2tf_default_native_serialization",
    "jax_auto_pcast", "jax_backend_target", "jax_captured_constants_report_frames",
    "jax_captured_constants_warn_bytes", "jax_check_proxy_envs", "jax_compilation_cache_dir",
    "jax_compilation_cache_include_metadata_in_key", "jax_compilation_cache_max_size",
    "jax_compiler_detailed_logging_min_ops", "jax_cpu_enable_async_dispatch",
    "jax_cpu_get_global_topology_timeout_minutes", "jax_cpu_get_local_topology_timeout_minutes",
    "jax_cross_host_transfer_socket_address", "jax_cross_host_transfer_timeout_seconds",
    "jax_cross_host_transfer_transfer_size", "jax_cross_host_transport_addresses",
    "jax_cuda_visible_devices", "jax_debug_leaked_clients_on_clear_backends",
    "jax_debug_log_modules", "jax_default_device", "jax_disable_bwd_checks",
    "jax_disable_vmap_shmap_error", "jax_distributed_debug",
    "jax_distributed_verify_secure_credentials", "jax_dump_ir_modes", "jax_dump_ir_to",
    "jax_embedded_constants_max_bytes", "jax_enable_compilation_cache",
    "jax_enable_preemption_service", "jax_enable_recoverability",
    "jax_experimental_unsafe_xla_runtime_errors", "jax_explain_cache_misses",
    "jax_export_calling_convention_version", "jax_export_deserialize_expired_versions",
    "jax_export_ignore_forward_compatibility", "jax_force_dcn_cross_host_transfers",
    "jax_hlo_source_file_canonicalization_regex", "jax_include_debug_info_in_dumps",
    "jax_include_full_tracebacks_in_locations", "jax_log_checkpoint_residuals",
    "jax_log_compiles", "jax_logging_level", "jax_mtls_ca_file", "jax_mtls_cert_file",
    "jax_mtls_key_file", "jax_mtls_peer_uri_prefix", "jax_num_cpu_devices",
    "jax_oneapi_visible_devices", "jax_pallas_auto_assign_collective_ids",
    "jax_pallas_auto_assign_collective_ids_limit", "jax_pallas_enable_debug_checks",
    "jax_pallas_verbose_errors", "jax_persistent_cache_enable_xla_caches",
    "jax_persistent_cache_min_compile_time_secs", "jax_persistent_cache_min_entry_size_bytes",
    "jax_pgle_aggregation_percentile", "jax_pgle_profiling_runs", "jax_platform_name",
    "jax_platforms", "jax_pprint_use_color", "jax_raise_on_ppermute_sort_diff",
    "jax_refs_to_pins", "jax_remove_custom_partitioning_ptr_from_cache_key",
    "jax_remove_size_one_mesh_axis_from_type", "jax_rocm_visible_devices",
    "jax_send_traceback_to_runtime", "jax_serialization_version",
    "jax_share_binary_between_hosts", "jax_share_binary_between_hosts_timeout_ms",
    "jax_sort_devices_by_process_index", "jax_source_url_schema", "jax_traceback_filtering",
    "jax_traceback_in_locations_limit", "jax_tracer_error_num_traceback_frames",
    "jax_use_cpp_shard_args", "jax_use_rgv3", "jax_use_simplified_jaxpr_constants",
    "jax_xla_backend",
})  # fmt: skip

# Variables of the environment that XLA reads flags from, and one of NVIDIA's libraries.
_FLAGS = ("XLA_FLAGS", "LIBTPU_INIT_ARGS")
_TF32 = "NVIDIA_TF32_OVERRIDE"
_FREE_FLAGS = ("--xla_dump_", "--xla_force_host_platform_device_count", "--xla_gpu_cuda_data_dir")


def fix() -> list[str]:
    """Sets all of `FIXED` and `CHECKS`; returns the names of those that had another value."""
    usual = {**FIXED, **CHECKS}
    others = [name for name in usual if _differs(name, usual[name])]
    for name in others:
        jax.config.update(name, usual[name])
    return others


def recorded() -> dict[str, str]:
    """Settings that change random numbers or arithmetic and are not the usual ones.

    Returns:
      name of the setting -> its value; empty where all is as usual, as `xla.prepare_xla` leaves it.
    """
    usual = {**FIXED, **RECORDED}
    names = [name for name in usual if _differs(name, usual[name])]
    # A jax newer than this list may have more of them; what the environment sets, it changes.
    known = usual.keys() | CHECKS.keys() | FREE
    names += [
        name for name in jax.config.values if name not in known and name.upper() in os.environ
    ]
    found = {name: str(_plain(_value(name))) for name in names}
    ours = xla.usual_flags()
    for name, value in sorted({**dict.fromkeys(ours, "unset"), **_flags()}.items()):
        if not name.startswith(_FREE_FLAGS) and ours.get(name) != value:
            found[name] = value
    if _TF32 in os.environ:
        found[_TF32] = os.environ[_TF32]
    return found


def record() -> dict[str, dict[str, str]]:
    """`recorded` as an entry of a JSON object; no entry where all is as usual."""
    found = recorded()
    return {"jax_settings": found} if found else {}


def _flags() -> dict[str, str]:
    """XLA's flags in the environment by name, of which the last of each name counts."""
    words = (word.partition("=") for text in map(xla.flags, _FLAGS) for word in text.split())
    return {name: value.lower() if equals else "true" for name, equals, value in words}


def _differs(name: str, usual: Any) -> bool:
    return name in jax.config.values and _plain(_value(name)) != usual


def _value(name: str) -> Any:
    """The value of a setting in this thread, where a context may have changed it."""
    return getattr(jax.config, name, jax.config.values[name])


def _plain(value: Any) -> Any:
    """A member of one of jax's enumerations as the word that sets it."""
    return value.name.lower() if hasattr(value, "name") else value
