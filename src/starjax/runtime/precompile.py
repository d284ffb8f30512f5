"""Programs traced once a machine, some of them compiled before their arguments exist.

All jobs of `start` are traced in one thread, as tracing holds Python's lock; compilers, which do
not, work side by side.
"""

import contextlib
import sys
import threading
from collections.abc import Callable, Hashable, Iterator
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from typing import Any, TypeVar

import jax
import numpy as np

from starjax.runtime import notice, stored, xla

T = TypeVar("T")

_thread = threading.local()
_tracer = ThreadPoolExecutor(1, thread_name_prefix="starjax-tracer")
# First in, first out, because the earliest programs are needed first; a GPU's compiler uses several
# cores itself. On two cores one compiler leaves the other core to the simulation.
_compilers = ThreadPoolExecutor(
    min(6, max(1, xla.cores() // 2)), thread_name_prefix="starjax-compiler"
)
_SWITCH_S = 2e-4  # Python's 5 ms would stop each wait of the main work behind the tracer
_queued: list[Future] = []


class Program:
    """A jitted function whose trace is stored, and executables compiled before it is called."""

    def __init__(self, function: Callable[..., Any], **options: Any):
        self._function = jax.jit(stored.program(function), **options)
        self._executables: dict[Hashable, Future] = {}

    def prepare(self, *args: Any) -> Any:
        """Traces the program here and compiles it in a thread.

        Args:
          args: arguments, or arrays' shapes with shardings.

        Returns:
          the result's shapes.
        """
        with stored.arguments(args):
            lowered = self._function.lower(*args)
        executable = _submit(_compilers, _marked(lowered.compile))
        self._executables[_signature(args)] = executable
        getattr(_thread, "started", []).append(executable)
        return lowered.out_info

    def is_prepared(self, *args: Any) -> bool:
        """Returns whether `prepare` was called for arguments of these shapes."""
        return _signature(args) in self._executables

    def select(self, *args: Any) -> Callable[..., Any]:
        """Returns the executable for arguments of these shapes, else the jitted function."""
        executable = self._executables.get(_signature(args)) if self._executables else None
        return _awaited(executable) if executable else self._call

    def __call__(self, *args: Any) -> Any:
        return self.select(*args)(*args)

    def shapes(self, *args: Any) -> Any:
        """Traces the program, and returns the shapes of its result without computing it."""
        with stored.arguments(args):
            return self._function.eval_shape(*args)

    def _call(self, *args: Any) -> Any:
        with stored.arguments(args), notice.call():
            return self._function(*args)


def start(job: Callable[[], T]) -> Callable[[], T | None]:
    """Queues a job that prepares programs.

    Returns:
      a function that waits until these are compiled, and returns the job's result; None if it
      failed, because the same error is raised where the program is called.
    """

    def run() -> tuple[T, list[Future]]:
        _thread.is_job, _thread.started = True, []
        return job(), _thread.started

    queued = _submit(_tracer, run)

    def wait() -> T | None:
        try:
            result, started = queued.result()
            for executable in started:
                _awaited(executable)
        except (Exception, CancelledError):
            return None
        return result

    return wait


@contextlib.contextmanager
def until_end() -> Iterator[None]:
    """Lets jobs work during the block.

    At its end those not begun are dropped, because the exit of Python would wait for them.
    """
    interval = sys.getswitchinterval()
    sys.setswitchinterval(_SWITCH_S)
    try:
        yield
    finally:
        sys.setswitchinterval(interval)
        while _queued:
            _queued.pop().cancel()


def is_job() -> bool:
    """Returns whether this thread works for a job of `start`, and thus for no stage of a run."""
    return getattr(_thread, "is_job", False)


def _awaited(executable: Future) -> Any:
    """Returns a compiled program, perhaps after a wait of which the user is told."""
    if executable.done():
        return executable.result()
    with notice.waiting():
        return executable.result()


def _submit(pool: ThreadPoolExecutor, work: Callable[[], Any]) -> Future:
    _queued[:] = [future for future in _queued if not future.done()]
    _queued.append(pool.submit(work))
    return _queued[-1]


def _marked(work: Callable[[], T]) -> Callable[[], T]:
    """Returns `work`, whose thread counts as a job's if this one does."""
    mark = is_job()

    def run() -> T:
        _thread.is_job = mark
        return work()

    return run


def _signature(args: Any) -> Hashable:
    """Returns the structure, shapes and types of arguments."""
    leaves, structure = jax.tree.flatten(args)
    return structure, tuple((np.shape(x), getattr(x, "dtype", type(x))) for x in leaves)
