"""Plans of a server as a policy's samples, through a host callback."""

import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import numpy as np
from jax.experimental import io_callback

from starjax import rcm
from starjax.core import types
from starjax.core.errors import UsageError
from starjax.core.types import Array, Command, Observation, Pose
from starjax.data.normalizer import Normalizer
from starjax.deploy import connection_pool, greeting, inputs


class RemotePolicy:
    """A server's plans as a policy's `sample`, one request per lane through a host callback.

    Lanes whose episode is over are not requested, and lanes that fill up a batch share the plan of
    their twin. A refused plan holds the measured pose.

    Attributes:
      origin: address and greeting, JSON values.
      refused: plans that the server refused or that were invalid.
      fault: the error that ended it, or None.
    """

    def __init__(
        self,
        connections: connection_pool.ConnectionPool,
        spec: inputs.InputSpec,
        horizon: int,
        encode: Callable[..., dict[str, Any]],
        decode: Callable[[Any, rcm.Trocar], Command],
        origin: dict[str, Any],
    ) -> None:
        self._link, self._spec, self.horizon = connections, spec, horizon
        self._encode, self._decode = encode, decode
        self._pool = ThreadPoolExecutor(greeting.MAX_CONNECTIONS, "starjax-remote")
        self.origin, self.refused = origin, 0
        self.fault: Exception | None = None

    def sample(
        self,
        done: Array,
        stats: Normalizer,
        keys: jax.Array,
        observation: Observation,
        trocar: rcm.TrocarFrame,
    ) -> Command:
        """Plans as `Policy.sample`; `done` `[B]` bool are the episodes without need of a plan."""
        batch, arms = observation.gripper.shape[0], observation.gripper.shape[2:]
        shape = (batch, self.horizon, *arms)
        f32: Any = functools.partial(jax.ShapeDtypeStruct, dtype=np.float32)
        result = Command(Pose(f32((*shape, 3, 3)), f32((*shape, 3))), f32(shape))
        seen = observation._replace(features=None, endoscope=None)
        data = jax.random.key_data(keys)
        return io_callback(self._plans, result, done, data, seen, trocar.trocar)

    def _plans(self, done: Array, keys: Any, seen: Observation, trocar: rcm.Trocar) -> Command:
        if self.fault:
            raise self.fault
        done, keys, seen, trocar = jax.tree.map(np.asarray, (done, keys, seen, trocar))
        held = Command(Pose(seen.pose.R[:, -1], seen.pose.p[:, -1]), seen.gripper[:, -1])
        plans = jax.tree.map(lambda x: np.repeat(x[:, None], self.horizon, 1), held)
        twins: dict[bytes, list[Any]] = {}
        for lane in np.flatnonzero(~done):
            twins.setdefault(keys[lane].tobytes(), []).append(lane)

        def request(lanes: list[Any]) -> Command | None:
            of_lane = functools.partial(jax.tree.map, lambda x: x[lanes[0]])
            return self._plan(of_lane(seen), of_lane(trocar), keys[lanes[0]])

        for lanes, plan in zip(
            twins.values(), self._pool.map(request, twins.values()), strict=True
        ):
            for lane in lanes if plan is not None else []:
                for whole, part in zip(jax.tree.leaves(plans), jax.tree.leaves(plan), strict=True):
                    whole[lane] = part.reshape(whole[lane].shape)
        return plans

    def _plan(self, seen: types.Observation, trocar: rcm.Trocar, key: np.ndarray) -> Command | None:
        """Returns the plan of one lane, None if it is refused."""
        if not self._spec.arms:
            pose = Pose(seen.pose.R[:, 0], seen.pose.p[:, 0])
            seen = seen._replace(pose=pose, gripper=seen.gripper[:, 0])
            trocar = rcm.Trocar(*(field[0] for field in trocar))
        moments = inputs.RobotObservation(
            seen.pose, seen.gripper, images=seen.images, state=seen.state
        )
        try:
            reply = self._link.ask(self._encode(moments, trocar, key))
            if not isinstance(reply, str):
                return self.check(self._decode(reply, trocar))
        except connection_pool.LostServer as error:
            self.fault = error
            raise
        except UsageError:
            pass
        self.refused += 1
        return None

    def check(self, command: Command) -> Command:
        """Returns a plan of the right length, of rotations, near the nominal trocars.

        Raises:
          UsageError: it is another.
        """
        R, p = command.pose
        if len(command.gripper) != self.horizon:
            raise UsageError("answer", f"{self.horizon} commands", len(command.gripper))
        if np.abs(np.swapaxes(R, -1, -2) @ R - np.eye(3)).max() > inputs.MAX_SKEW:
            raise UsageError("answer.R", "rotations", "another matrix")
        if np.linalg.norm(p - self._spec.p_world_ref, axis=-1).max() > inputs.FARTHEST:
            expected = f"tips within {inputs.FARTHEST} m of the nominal trocar"
            raise UsageError("answer.p", expected, "one farther away")
        return command
