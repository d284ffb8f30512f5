"""Digests of functions with all that their closures hold, without tracing them.

Code is known by its name: the digest of a program adds that of the sources of its modules.
"""

import dataclasses
import enum
import functools
import hashlib
import sys
import types
from collections.abc import Iterable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

_PLAIN = (type(None), type(...), bool, int, float, complex, str, bytes)
_BY_NAME = (type, types.BuiltinFunctionType, np.ufunc)
_BY_REPR = (
    np.dtype, jax.ShapeDtypeStruct, jax.sharding.Mesh, jax.sharding.PartitionSpec,
    jax.sharding.Sharding,
)  # fmt: skip
# Functions of scripts and notebooks see variables that change, and are in no file of a package.
_INTERACTIVE = ("__main__", "__mp_main__")


def of(*objects: Any) -> tuple[str, set[str]]:
    """Returns the digest of objects: constants, containers, arrays, functions with closures.

    Returns:
      the digest of their values, and the modules that define their functions and types.

    Raises:
      TypeError: one holds an object of another kind, or a function of a script or a notebook.
    """
    walk = _Walk()
    for x in objects:
        walk.add(x)
    return walk.total.hexdigest(), walk.modules


class _Walk:
    """The digest of the objects so far."""

    def __init__(self) -> None:
        self.total, self.modules = hashlib.sha256(), set[str]()
        self._seen: dict[int, tuple[int, Any]] = {}

    def add(self, x: Any) -> None:
        if type(x) in _PLAIN:
            return self._words(x)
        if isinstance(x, enum.Enum):
            return self._words(self._name(type(x)), x.name)
        if isinstance(x, types.ModuleType):
            self.modules.add(x.__name__)
            return self._words("module", x.__name__)
        if isinstance(x, _BY_NAME):
            return self._words(self._name(x))
        if type(x) is object:  # a mark, such as jax.vmap's for "no axis"
            return self._words("object")
        if id(x) in self._seen:
            return self._words("again", self._seen[id(x)][0])
        self._seen[id(x)] = len(self._seen), x  # keeps it alive: no other object gets its id
        if isinstance(x, np.ndarray | np.generic | jax.Array):
            return self._array(x)
        mujoco = sys.modules.get("mujoco")  # a policy needs no simulator
        if mujoco and isinstance(x, mujoco.MjModel):
            buffer = np.zeros(mujoco.mj_sizeModel(x), np.uint8)
            mujoco.mj_saveModel(x, None, buffer)
            return self._array(buffer)
        if isinstance(x, _BY_REPR):
            return self._words(repr(x))
        return self._parts(*self._taken_apart(x))

    def _taken_apart(self, x: Any) -> tuple[str, Iterable[tuple[Any, Any]]]:
        """Returns the kind of an object and its parts by name."""
        if isinstance(x, functools.partial):
            return "partial", [("", x.func), ("", x.args), ("", x.keywords)]
        if isinstance(x, types.MethodType):
            return "method", [("", x.__func__), ("", x.__self__)]
        if isinstance(x, types.FunctionType):
            cells = zip(x.__code__.co_freevars, x.__closure__ or ())
            closure = [(name, _content(cell)) for name, cell in cells]
            rest = [("", x.__code__), ("", x.__defaults__), ("", x.__kwdefaults__)]
            return self._name(x), [*closure, *rest]
        if isinstance(x, types.CodeType):
            return x.co_code.hex(), [(x.co_names, x.co_consts)]
        if isinstance(x, tuple) and hasattr(x, "_fields"):
            return self._name(type(x)), zip(x._fields, x)
        if isinstance(x, slice | range):
            return type(x).__name__, [("", (x.start, x.stop, x.step))]
        if isinstance(x, tuple | list):
            return type(x).__name__, enumerate(x)
        if isinstance(x, frozenset | set):
            return "set", enumerate(sorted(x, key=repr))
        if isinstance(x, Mapping):
            return "mapping", x.items()
        if dataclasses.is_dataclass(x):
            fields = dataclasses.fields(x)
            return self._name(type(x)), [(f.name, getattr(x, f.name, None)) for f in fields]
        if callable(x) and hasattr(x, "__wrapped__"):  # jax.jit, custom_vjp, functools.cache
            public = {name: part for name, part in vars(x).items() if not name.startswith("_")}
            options = repr(getattr(x, "_jit_info", ""))
            return self._name(type(x)), [(options, x.__wrapped__), *public.items()]
        raise TypeError(f"{self._name(type(x))}: {x!r:.80}")

    def _parts(self, kind: str, named: Iterable[tuple[Any, Any]]) -> None:
        self._words(kind)
        for name, x in named:
            self._words(name)
            self.add(x)
        self._words()

    def _words(self, *words: Any) -> None:
        self.total.update(repr(words).encode())

    def _array(self, x: Any) -> None:
        if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            self._words(str(x.dtype))
            x = jax.random.key_data(x)
        self._words(str(x.dtype), x.shape, getattr(x, "weak_type", False))
        self.total.update(np.ascontiguousarray(x).tobytes())

    def _name(self, x: Any) -> str:
        module = getattr(x, "__module__", None) or "builtins"
        if module in _INTERACTIVE:
            raise TypeError(f"{x!r:.80} of a script or a notebook")
        self.modules.add(module)
        return f"{module}:{getattr(x, '__qualname__', x.__name__)}"


def _content(cell: types.CellType) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # from a function that is defined later
        return None
