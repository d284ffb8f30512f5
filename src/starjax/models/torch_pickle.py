"""Interprets the pickle inside a torch file as plain data; nothing that it names is looked up.

A pickle is a program that calls functions by name. Here its opcodes are only parsed; the few that a
dictionary of tensors needs are carried out on lists, dictionaries and the records below, and any
other opcode or name is refused.
"""

import pickletools
from typing import IO, Any, NamedTuple

import numpy as np

DTYPES = {
    "FloatStorage": np.dtype("<f4"),
    "DoubleStorage": np.dtype("<f8"),
    "HalfStorage": np.dtype("<f2"),
    "LongStorage": np.dtype("<i8"),
    "IntStorage": np.dtype("<i4"),
}
_CALLABLES = {
    ("collections", "OrderedDict"),
    ("torch._utils", "_rebuild_tensor_v2"),
    ("torch._utils", "_rebuild_parameter"),
}
_PUSH = {
    *("BINUNICODE", "SHORT_BINUNICODE", "BINSTRING", "SHORT_BINSTRING"),
    *("BINFLOAT", "BININT", "BININT1", "BININT2", "LONG1"),
}
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False, "EMPTY_TUPLE": ()}
_TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}


class Storage(NamedTuple):
    """A buffer that the file holds elsewhere."""

    key: str
    dtype: np.dtype
    numel: int


class Tensor(NamedTuple):
    """A view of a storage, in elements. Sizes and offsets are the file's claim, not checked yet."""

    storage: Storage
    offset: int
    size: tuple[int, ...]
    stride: tuple[int, ...]


class _Name(NamedTuple):
    """A global that the pickle mentions; it is only ever compared."""

    module: str
    name: str


def interpret(stream: IO[bytes]) -> Any:
    """The value of the pickle at `stream`, of str, numbers, tuple, list, dict and `Tensor` alone.

    Raises ValueError for what is not allowed, and whatever Python raises on a malformed program.
    """
    stack: list[Any] = []
    marks: list[int] = []
    memo: dict[int, Any] = {}

    def pop_to_mark() -> list[Any]:
        start = marks.pop()
        items = stack[start:]
        del stack[start:]
        return items

    argument: Any
    for opcode, argument, _ in pickletools.genops(stream):
        match opcode.name:
            case "PROTO" | "FRAME":
                pass
            case "STOP":
                return stack.pop()
            case "MARK":
                marks.append(len(stack))
            case name if name in _PUSH:
                stack.append(argument)
            case name if name in _CONSTANTS:
                stack.append(_CONSTANTS[name])
            case "EMPTY_DICT":
                stack.append({})
            case "EMPTY_LIST":
                stack.append([])
            case "TUPLE":
                stack.append(tuple(pop_to_mark()))
            case name if name in _TUPLES:
                items = [stack.pop() for _ in range(_TUPLES[name])]
                stack.append(tuple(reversed(items)))
            case "BINPUT" | "LONG_BINPUT":
                memo[argument] = stack[-1]
            case "MEMOIZE":
                memo[len(memo)] = stack[-1]
            case "BINGET" | "LONG_BINGET":
                stack.append(memo[argument])
            case "APPEND":
                item = stack.pop()
                stack[-1].append(item)
            case "APPENDS":
                items = pop_to_mark()
                stack[-1].extend(items)
            case "SETITEM":
                items = [stack.pop(), stack.pop()]
                _set_items(stack[-1], items[::-1])
            case "SETITEMS":
                items = pop_to_mark()
                _set_items(stack[-1], items)
            case "GLOBAL":
                stack.append(_Name(*argument.split(" ")))
            case "STACK_GLOBAL":
                attribute, module = stack.pop(), stack.pop()
                stack.append(_Name(module, attribute))
            case "BINPERSID":
                stack.append(_storage(stack.pop()))
            case "REDUCE":
                arguments, function = stack.pop(), stack.pop()
                stack.append(_call(function, arguments))
            case "BUILD":
                stack.pop()  # attributes of the dictionary (its _metadata): not needed
            case name:
                raise ValueError(f"pickle opcode {name} is not allowed")
    raise ValueError("pickle without an end")


def _set_items(target: Any, items: list[Any]) -> None:
    if not isinstance(target, dict):
        raise ValueError(f"items set on {type(target).__name__}")
    for key, value in zip(items[::2], items[1::2], strict=True):
        # Other keys are refused: hashing tuples nested through the memo can take for ever.
        if not isinstance(key, str | int):
            raise ValueError(f"key of type {type(key).__name__}")
        target[key] = value


def _call(function: Any, arguments: Any) -> Any:
    """What the allowed functions would have built, as plain data."""
    if not isinstance(function, _Name):
        raise ValueError(f"call of {type(function).__name__}")
    if function not in _CALLABLES:
        raise ValueError(f"call of {function.module}.{function.name} is not allowed")
    if function.name == "OrderedDict":
        if arguments:
            raise ValueError("OrderedDict with arguments")
        return {}
    if function.name == "_rebuild_parameter":
        return arguments[0]
    storage, offset, size, stride = arguments[:4]
    if not isinstance(storage, Storage):
        raise ValueError("tensor without a storage")
    return Tensor(storage, offset, tuple(size), tuple(stride))


def _storage(persistent_id: Any) -> Storage:
    tag, kind, key, _, numel, *view = persistent_id
    if tag != "storage" or not isinstance(kind, _Name) or kind.module != "torch" or any(view):
        raise ValueError("persistent object that is not a plain storage")
    if kind.name not in DTYPES:
        raise ValueError(f"storage of {kind.name}, expected one of {sorted(DTYPES)}")
    return Storage(str(key), DTYPES[kind.name], numel)
