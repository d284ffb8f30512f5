"""Batched inference for several clients: fixed batch sizes, errors per client."""

import time
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm
from starjax.core import types
from starjax.core.errors import UsageError
from starjax.deploy import inputs, wire
from starjax.deploy.policy import Deployed
from starjax.rcm import arrays
from starjax.sim import trocar_region

_DOWN = np.array([0.0, 0.0, -1.0], np.float32)
_DEPTH = 0.07  # m, of the tool that the programs are compiled with


class Batches:
    """Plans for up to `max_robots` robots at once, with programs of 1, 2, 4, ... robots.

    Attributes:
      sizes: batch sizes; a smaller batch is padded with its first robot.
      key_size: words of a random key's data.
    """

    def __init__(self, policy: Deployed, max_robots: int, seed: int | None = None) -> None:
        self.policy, self.max_robots = policy, max_robots
        self.sizes = [*(1 << n for n in range((max_robots - 1).bit_length())), max_robots]
        self.key_size = jax.random.key_data(jax.random.key(0)).shape[-1]
        self._rng = np.random.default_rng(seed)

    def warm_up(self) -> None:
        """Compiles the programs of all sizes, so no request waits for a compilation."""
        for size in self.sizes:
            self.infer([example(self.policy.input_spec)] * size)

    @arrays.broadcasting
    def infer(self, requests: Sequence[wire.Request]) -> list[dict[str, Any] | UsageError]:
        """Answers up to `max_robots` requests, each by `wire.encode_reply` or its error."""
        begun = time.perf_counter()
        replies: list[Any] = [None] * len(requests)
        valid, rows = [], []
        for i, request in enumerate(requests):
            try:
                spec, off = self.policy.input_spec, self.policy.max_off_trocar
                rows.append(inputs.validate(spec, request.observation, request.trocar, off))
                valid.append(i)
            except UsageError as error:
                replies[i] = error
            except ValueError as error:  # from `rcm.check_trocar`
                replies[i] = UsageError("trocar", "finite radius >= 0 and angles", str(error))
        if not valid:
            return replies
        size = next(size for size in self.sizes if size >= len(valid))
        padding = size - len(valid)
        rows += rows[:1] * padding
        keys = [self._key(requests[i].key) for i in valid]
        keys = jnp.asarray(np.stack([*keys, *keys[:1] * padding]))
        sensors, trocar = jax.tree.map(lambda *parts: np.stack(parts), *rows)
        plans = self.policy.plan(jax.random.wrap_key_data(keys), sensors, trocar)
        plans = jax.device_get(plans)
        infer_ms = 1e3 * (time.perf_counter() - begun)
        for row, i in enumerate(valid):
            command, offset = jax.tree.map(lambda x: x[row], plans)  # noqa: B023
            try:
                self.policy.check_first(offset)
                replies[i] = wire.encode_reply(command, infer_ms)
            except UsageError as error:
                replies[i] = error
        return replies

    def _key(self, data: np.ndarray | None) -> np.ndarray:
        if data is not None:
            return data
        return self._rng.integers(0, 1 << 32, self.key_size, np.uint32)


def example(spec: inputs.InputSpec) -> wire.Request:
    """Returns a request of tools at rest in trocars near the nominal ones, straight down."""
    place = np.array(spec.p_world_ref, np.float32)
    for arm, region in enumerate(spec.regions):
        # Several arms' trocars never lie at the nominal one.
        place.reshape(-1, 3)[arm] += trocar_region.clipped(region, np.zeros(3))
    trocar = rcm.trocar_from_position(place, spec.p_world_ref)
    trocar = rcm.Trocar(*(np.asarray(field) for field in trocar))
    pose = rcm.pose_on_manifold(_DOWN, 0.0, _DEPTH, place)
    repeated: list[Any] = [np.broadcast_to(x, (spec.moments, *np.shape(x))) for x in pose]
    size = (spec.moments, spec.image_size, spec.image_size, 3)
    images = {name: np.zeros(size, np.uint8) for name in spec.cameras}
    observation = inputs.RobotObservation(
        pose=types.Pose(*repeated),
        gripper=np.ones((spec.moments, *spec.arms), np.float32),
        images=images or None,
        state=None if images else np.zeros((spec.moments, spec.state_size), np.float32),
    )
    return wire.Request(observation, trocar, None)
