"""Requests as clients of openpi make them, turned into those that `wire` reads.

A request may have `prompt`, images of other sizes and types, the columns of `plain`, and one moment
instead of O: the server then completes it with the client's previous ones.
"""

import collections
from typing import Any

import numpy as np

from starjax.core.errors import UsageError
from starjax.data import pose_rows
from starjax.deploy import images, wire
from starjax.deploy.inputs import InputSpec

_IGNORED = ("prompt",)
_PLAIN = "observation/"
RESET = "reset"  # true in the first request of an episode: earlier moments do not count

Arrays = dict[str, Any]


class History:
    """The last moments that a client sent one at a time."""

    def __init__(self, spec: InputSpec) -> None:
        self._spec = spec
        self._moments: collections.deque[Arrays] = collections.deque(maxlen=spec.moments)

    def complete(self, request: Any) -> tuple[Any, Arrays | None]:
        """Returns a request of O moments, and its own moment if it had one, for `keep`.

        Before O moments have come, the first one is repeated.

        Raises:
          UsageError: an image or a plain column cannot be read.
        """
        if not isinstance(request, dict):
            return request, None
        request = {name: value for name, value in request.items() if name not in _IGNORED}
        if request.pop(RESET, False):
            self._moments.clear()
        request = _from_plain(self._spec, request)
        shapes = {
            name: row.shape
            for name, row in wire.request_arrays(self._spec).items()
            if name not in ("trocar", wire.SPHERICAL, "key")
        }
        for name in set(map(self._image_field, self._spec.cameras)) & set(request):
            if isinstance(request[name], np.ndarray):
                size, moments = self._spec.image_size, self._spec.moments
                request[name] = images.adapt(name, request[name], size, moments)
        single = {
            name: np.asarray(request[name])
            for name, shape in shapes.items()
            if np.ndim(request.get(name)) == len(shape) - 1 and _is_numeric(request.get(name))
        }
        if set(single) != set(shapes):
            return request, None
        moments = [*self._moments, single]
        moments = [moments[0]] * (self._spec.moments - len(moments)) + moments
        moments = moments[-self._spec.moments :]
        try:
            stacked = {name: np.stack([moment[name] for moment in moments]) for name in shapes}
        except ValueError:  # from another shape than the moments before
            return request, None
        return request | stacked, single

    def keep(self, moment: Arrays | None) -> None:
        """Adds the moment of a request that was answered."""
        if moment is not None:
            self._moments.append(moment)

    def _image_field(self, camera: str) -> str:
        return wire.image_field(self._spec, camera)


def _is_numeric(value: Any) -> bool:
    return isinstance(value, np.ndarray | np.generic | int | float)


def _from_plain(spec: InputSpec, request: Arrays) -> Arrays:
    """Renames the columns of an export: `observation/state` becomes R, p and gripper."""
    renamed = {}
    for name, value in request.items():
        column = name.removeprefix(_PLAIN) if isinstance(name, str) else name
        if column == name:
            renamed[name] = value
        elif column == "state":
            renamed |= _from_state(spec, value)
        elif column == "environment_state":
            renamed["state"] = value
        elif column == "trocar":
            size = np.prod((*spec.arms, 3))
            fits = isinstance(value, np.ndarray) and value.size == size
            renamed["trocar"] = value.reshape(*spec.arms, 3) if fits else value
        else:
            renamed[wire.image_field(spec, column)] = value
    return renamed


def _from_state(spec: InputSpec, rows: np.ndarray) -> Arrays:
    width = pose_rows.COLUMNS * (spec.arms[0] if spec.arms else 1)
    shape = np.shape(rows)
    if not isinstance(rows, np.ndarray) or rows.dtype.kind not in "fiu" or shape[-1:] != (width,):
        raise UsageError("observation/state", f"[{width}] numbers", list(shape))
    p, R, gripper = pose_rows.unpack("observation/state", rows)
    if not spec.arms:
        p, R, gripper = p[..., 0, :], R[..., 0, :, :], gripper[..., 0]
    return {"R": R, "p": p, "gripper": gripper}
