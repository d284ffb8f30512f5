"""Reads the tensors of a torch `.pth` file without torch and without running its pickle.

Both containers are known: a zip archive (torch >= 1.6) and the older run of pickles and buffers.
Every size, offset and stride is checked against the bytes that are really there.
"""

import math
import pathlib
import zipfile
from typing import IO, Any

import numpy as np

from starjax.models import torch_pickle
from starjax.models.torch_pickle import Tensor

_LEGACY_MAGIC = 0x1950A86A20F9469CFC6C
_MAX_BYTES = 1 << 30  # of a file, also unpacked; ResNet-18 is 45 MB


def read(path: str | pathlib.Path) -> dict[str, np.ndarray]:
    """The state dictionary of a `.pth` file; entries that are not tensors are left out.

    Raises:
      ValueError: the file is damaged, or is not a plain dictionary of tensors.
    """
    path = pathlib.Path(path)
    _check_size(path.stat().st_size)
    try:
        with path.open("rb") as file:
            is_zip = file.read(4) == b"PK\x03\x04"
            file.seek(0)
            tensors, storages = _read_zip(file) if is_zip else _read_legacy(file)
        for tensor in tensors.values():
            _check_tensor(tensor)
        _check_size(sum(math.prod(t.size) * t.storage.dtype.itemsize for t in tensors.values()))
        return {name: _materialize(tensor, storages) for name, tensor in tensors.items()}
    # Damaged or hostile bytes can break the interpreter in any way; the caller needs one.
    except Exception as error:
        raise ValueError(f"{path}: not a readable torch state dictionary: {error}") from error


def _read_zip(file: IO[bytes]) -> tuple[dict[str, Tensor], dict[str, bytes]]:
    """`<root>/data.pkl`, and one `<root>/data/<key>` for each storage."""
    with zipfile.ZipFile(file) as archive:
        _check_size(sum(info.file_size for info in archive.infolist()))
        names = archive.namelist()
        pickles = [name for name in names if name.endswith("/data.pkl")]
        if len(pickles) != 1:
            raise ValueError(f"expected one data.pkl, got {len(pickles)}")
        root = pickles[0].removesuffix("data.pkl")
        if root + "byteorder" in names and archive.read(root + "byteorder") != b"little":
            raise ValueError("expected little-endian storages")
        with archive.open(pickles[0]) as stream:
            tensors = _tensors(torch_pickle.interpret(stream))
        keys = {tensor.storage.key for tensor in tensors.values()}
        return tensors, {key: archive.read(f"{root}data/{key}") for key in keys}


def _read_legacy(file: IO[bytes]) -> tuple[dict[str, Tensor], dict[str, bytes]]:
    """Pickles of magic, version, system, dictionary and keys; then a length and bytes per key."""
    magic, version, system = (torch_pickle.interpret(file) for _ in range(3))
    if magic != _LEGACY_MAGIC or version != 1001 or not system["little_endian"]:
        raise ValueError("expected a zip archive or torch's older container, little-endian")
    tensors = _tensors(torch_pickle.interpret(file))
    known = {tensor.storage.key: tensor.storage for tensor in tensors.values()}
    storages = {}
    for key in torch_pickle.interpret(file):
        numel = int.from_bytes(file.read(8), "little")
        if numel != known[key].numel:
            raise ValueError(f"storage {key}: expected {known[key].numel} elements, got {numel}")
        size = numel * known[key].dtype.itemsize
        _check_size(size)
        storages[key] = file.read(size)
    return tensors, storages


def _tensors(state: Any) -> dict[str, Tensor]:
    if not isinstance(state, dict):
        raise ValueError(f"expected a dictionary of tensors, got {type(state).__name__}")
    return {str(name): value for name, value in state.items() if isinstance(value, Tensor)}


def _check_size(size: int) -> None:
    if size > _MAX_BYTES:
        raise ValueError(f"torch file: expected at most {_MAX_BYTES} bytes, got {size}")


def _check_tensor(tensor: Tensor) -> None:
    """The view lies within its storage and, with a stride of zero, is not larger than it."""
    storage, offset, size, stride = tensor
    numbers = (storage.numel, offset, *size, *stride)
    if len(size) != len(stride) or not all(type(n) is int and n >= 0 for n in numbers):
        raise ValueError("tensor whose size, stride or offset are not natural numbers")
    last = offset + sum((n - 1) * step for n, step in zip(size, stride))
    elements = math.prod(size)
    if elements > storage.numel or (elements and last >= storage.numel):
        raise ValueError(f"tensor {size}, stride {stride}, offset {offset} leaves its storage")


def _materialize(tensor: Tensor, storages: dict[str, bytes]) -> np.ndarray:
    """A copy of the tensor's elements; call `_check_tensor` first."""
    storage, offset, size, stride = tensor
    data = storages[storage.key]
    if len(data) != storage.numel * storage.dtype.itemsize:
        raise ValueError(f"storage {storage.key}: expected {storage.numel} elements")
    if not math.prod(size):
        return np.zeros(size, storage.dtype)
    flat = np.frombuffer(data, storage.dtype)[offset:]
    steps = tuple(step * storage.dtype.itemsize for step in stride)
    return np.lib.stride_tricks.as_strided(flat, size, steps, writeable=False).copy()
