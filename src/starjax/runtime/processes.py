"""Several processes as one run: joining it, agreeing, and acting alone.

Every process runs the same command on a shared folder, with JAX_COORDINATOR_ADDRESS (host:port of
the first one), JAX_NUM_PROCESSES and JAX_PROCESS_ID set, or as a step of `srun`, whose variables
say the same. All train together and write the arrays of checkpoints, and each makes its share of
demonstrations and trials (`rollouts.sharing`); the first does everything else alone, such as
writing other files. With one process nothing here does anything.
"""

import atexit
import functools
import hashlib
import json
import os
import re
import secrets
import sys
from concurrent.futures import wait
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import NamedSharding

from starjax.core import errors
from starjax.core.types import Array, Tree
from starjax.runtime import background

_VARIABLES = ("JAX_COORDINATOR_ADDRESS", "JAX_NUM_PROCESSES", "JAX_PROCESS_ID")
_SLURM_TASKS = "SLURM_STEP_NUM_TASKS"
_PREEMPTION = "jax_enable_preemption_service"
# A process that ended without a word is missed after so long; jax's own is 100.
_HEARTBEAT_S = 30
_SILENT_S, _LATEST_S = 2, 120  # before a line says that a process waits, and before it gives up
LOST_HINT = "starjax: if a process of this run is lost, the others stop; rerun the same command"


def join() -> None:
    """Joins the run that the variables name, once, if they do; call it before the first jax array.

    In a step of `srun` with several tasks they need not be set; JAX_NUM_PROCESSES=1 alone keeps its
    tasks apart.

    Raises:
      UsageError: some of the variables are missing or are no numbers.
    """
    address, *numbers = (os.environ.get(name, "") for name in _VARIABLES)
    if jax.distributed.is_initialized() or [address, *numbers] == ["", "1", ""]:
        return
    if not address and not any(numbers):
        if (tasks := _tasks_of_step()) > 1:
            _initialize(_SLURM_TASKS, tasks, "JAX_NUM_PROCESSES=1 runs each task alone")
        return
    if not address or not all(number.isdigit() for number in numbers):
        raise errors.UsageError(
            ", ".join(_VARIABLES),
            "all or none of them, the last two whole numbers",
            [address, *numbers],
        )
    count, index = map(int, numbers)
    if index >= count:
        raise errors.UsageError("JAX_PROCESS_ID", f"0 to {count - 1}", index)
    _initialize(
        "JAX_NUM_PROCESSES",
        count,
        f"this is process {index}, they meet at {address}",
        coordinator_address=address,
        num_processes=count,
        process_id=index,
    )


def _tasks_of_step() -> int:
    """Returns the number of tasks of this step of `srun`, 1 without one.

    Raises:
      UsageError: the variable has another form than `4` or `2(x2),1`.
    """
    text = os.environ.get(_SLURM_TASKS) or "1"
    parts = [re.fullmatch(r"(\d+)(?:\(x(\d+)\))?", part) for part in text.split(",")]
    if not all(parts):
        raise errors.UsageError(_SLURM_TASKS, "a number of tasks", repr(text))
    return sum(int(part[1]) * int(part[2] or 1) for part in parts if part)


def _initialize(variable: str, count: int, hint: str, **options: Any) -> None:
    """Connects the processes of a run; jax takes missing arguments from the variables of `srun`.

    Args:
      variable: of the environment that says their number, `count`.
      hint: for the line of a process that waits.
      options: of `jax.distributed.initialize`.

    Raises:
      UsageError: they do not come, or the arguments cannot be used.
    """
    # Its handler of SIGTERM, in C++, would take the signal from Python's.
    if hasattr(jax.config, _PREEMPTION):
        jax.config.update(_PREEMPTION, False)
    # It waits in C++, which answers no signal and aborts the process where the others do not come.
    joined = background.run_as_daemon(
        lambda: jax.distributed.initialize(
            heartbeat_timeout_seconds=_HEARTBEAT_S,
            initialization_timeout=2 * _LATEST_S,
            **options,
        )
    )
    if not wait([joined], _SILENT_S).done:
        line = f"starjax: waits for {count} processes ({variable}), up to {_LATEST_S} s; {hint}"
        print(line, file=sys.stderr, flush=True)
    try:
        joined.result(_LATEST_S)
    except (TimeoutError, RuntimeError, ValueError, KeyError) as error:
        atexit.register(os._exit, 2)  # before jax's own exit, which would wait for the others, too
        got = error if str(error) else f"fewer after {_LATEST_S} s"
        raise errors.UsageError(variable, f"{count} processes that join", got, hint) from error
    if is_first():  # in advance, because jax's C++ code aborts the others when a process is lost
        print(LOST_HINT, file=sys.stderr, flush=True)


def is_alone() -> bool:
    """Returns whether this process is the whole run."""
    return jax.process_count() == 1


def is_first() -> bool:
    """Returns whether this process is the one that writes."""
    return jax.process_index() == 0


@functools.cache
def run_number() -> int:
    """Returns a number that all processes of this run have, and hardly any other run."""
    return agree(secrets.randbelow(2**31))[0]


def agree(*values: int) -> tuple[int, ...]:
    """Returns the first process's values, in all of them; each waits here for the others."""
    return tuple(values_of_all[0] for values_of_all in gathered(*values))


def gathered(*values: int) -> list[list[int]]:
    """Gathers each value from all processes, in their order; each waits here for the others."""
    if is_alone():
        return [[value] for value in values]
    values_of_all = multihost_utils.process_allgather(np.array(values, np.int32))
    return np.asarray(values_of_all).T.tolist()


def expect_same(what: str, text: str, values: Any = None) -> None:
    """Checks that all processes have the same text and JSON values; each waits here for the others.

    Raises:
      UsageError: they have not, in every process.
    """
    content = json.dumps([text, values], sort_keys=True)
    digest = int.from_bytes(hashlib.sha256(content.encode()).digest()[:3])
    (digests,) = gathered(digest)
    if len(set(digests)) > 1:
        got = f"{len(set(digests))} different ones; process {jax.process_index()} has {text}"
        raise errors.UsageError(what, "the same in all processes", got)


def spread(x: Array, sharding: NamedSharding, may_alias: bool | None) -> jax.Array:
    """Returns an array over the devices of all processes, of which each holds all of `x`.

    `may_alias`, of `jax.device_put`: whether it may share the memory of `x`.
    """
    x = x if isinstance(x, jax.Array) else np.asarray(x)
    whole = sharding.is_fully_replicated
    parts = [
        jax.device_put(x if whole else x[index], device, may_alias=may_alias)
        for device, index in sharding.addressable_devices_indices_map(x.shape).items()
    ]
    return jax.make_array_from_single_device_arrays(x.shape, sharding, parts)


def own(tree: Tree) -> Tree:
    """Returns this process's copy of arrays that are replicated over all processes."""
    if is_alone():
        return tree
    return jax.tree.map(lambda x: x.addressable_data(0), tree)
