"""Plans of several clients in one call: fixed batch sizes, every client's mistakes its own."""

import time
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm, types
from starjax.deploy import inputs, wire
from starjax.deploy.policy import Deployed
from starjax.errors import UsageError
from starjax.rcm import arrays

_DOWN = np.array([0.0, 0.0, -1.0], np.float32)
_DEEP = 0.07  # m, of the tool that a program is warmed up with


class Batches:
    """Decides for at most `most` robots at once, with programs of 1, 2, 4, ... of them.

    Attributes:
      sizes: of the batches; a smaller one is filled up with its first robot.
      key_size: words of a random key's data.
    """

    def __init__(self, policy: Deployed, most: int, seed: int | None = None) -> None:
        self.policy, self.most = policy, most
        self.sizes = [*(1 << n for n in range((most - 1).bit_length())), most]
        self.key_size = jax.random.key_data(jax.random.key(0)).shape[-1]
        self._drawn = np.random.default_rng(seed)

    def warm_up(self) -> None:
        """Compiles the program of every size, so that no request waits for it."""
        for size in self.sizes:
            self.decide([example(self.policy)] * size)

    @arrays.broadcasting
    def decide(self, requests: Sequence[wire.Request]) -> list[dict[str, Any] | UsageError]:
        """Answers at most `most` requests: each with its `wire.encode_reply`, or its mistake."""
        begun, spec = time.perf_counter(), self.policy.input_spec
        answers: list[Any] = [None] * len(requests)
        good, rows = [], []
        for i, asked in enumerate(requests):
            try:
                rows.append(inputs.validate(spec, asked.observation, asked.trocar))
                good.append(i)
            except UsageError as error:
                answers[i] = error
            except ValueError as error:  # `rcm.check_trocar`
                answers[i] = UsageError("trocar", "a trocar", str(error))
        if not good:
            return answers
        size = next(size for size in self.sizes if size >= len(good))
        rows += rows[:1] * (size - len(rows))
        keys = [self._key(requests[i].key) for i in good]
        keys = np.stack([*keys, *keys[:1] * (size - len(keys))])
        seen, trocar = jax.tree.map(lambda *parts: np.stack(parts), *rows)
        planned = self.policy.plan(jax.random.wrap_key_data(jnp.asarray(keys)), seen, trocar)
        command, found = jax.device_get(planned)
        decided_ms = 1e3 * (time.perf_counter() - begun)
        for row, i in enumerate(good):
            one, first = (jax.tree.map(lambda x: x[row], part) for part in (command, found))  # noqa: B023
            try:
                self.policy.check_first(first)
                answers[i] = wire.encode_reply(one, decided_ms)
            except UsageError as error:
                answers[i] = error
        return answers

    def _key(self, given: np.ndarray | None) -> np.ndarray:
        if given is not None:
            return given
        return self._drawn.integers(0, 1 << 32, self.key_size, np.uint32)


def example(policy: Deployed) -> wire.Request:
    """A request of tools at rest in the nominal trocars, straight down."""
    spec = policy.input_spec
    trocar = rcm.Trocar(*(np.full(spec.arms, x, np.float32) for x in (0.0, np.pi / 2, 0.0)))
    pose = rcm.pose_on_manifold(_DOWN, 0.0, _DEEP, spec.p_world_ref)
    moments = (spec.moments, *spec.arms)
    repeated: list[Any] = [np.broadcast_to(x, (spec.moments, *np.shape(x))) for x in pose]
    side = (spec.moments, spec.image_size, spec.image_size, 3)
    images = {name: np.zeros(side, np.uint8) for name in spec.cameras}
    observation = inputs.RobotObservation(
        pose=types.Pose(*repeated),
        gripper=np.ones(moments, np.float32),
        images=images or None,
        state=None if images else np.zeros((spec.moments, spec.state_size), np.float32),
    )
    return wire.Request(observation, trocar, None)
