"""Batch of environments whose arrays stay on the device, as jax's or as torch's by DLPack.

>>> env = on_device.TaskDeviceEnv(4096, task="reach", arrays="torch")
>>> observed, info = env.reset(seed=0)
>>> observed, reward, terminated, truncated, info = env.step(policy(observed))

Torch's tensors share the memory of jax's arrays, which are constant: do not write into them.
"""

import importlib
from collections.abc import Callable
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import AutoresetMode
from jax.typing import ArrayLike

from starjax.core import errors
from starjax.envs import batch, vector

ARRAYS = ("jax", "torch")


class TaskDeviceEnv(vector.TaskVectorEnv):
    """N episodes of a task side by side, without a copy to the host.

    As `TaskVectorEnv`, except: all returned arrays lie on jax's device, rewards are float32, and
    with SAME_STEP `info` always has `final_obs` and `final_info` of all lanes, valid where
    `_final_obs` is true. NaN in actions are not looked for.
    """

    def __init__(self, num_envs: int = 1, *, arrays: str = "jax", **arguments: Any) -> None:
        """Makes the environments; the first reset compiles their program.

        Args:
          num_envs: N.
          arrays: `jax` or `torch`, of observations, rewards, flags and `info`. Actions may be of
            either, on the same device, or numpy's.
          arguments: see `TaskVectorEnv`.

        Raises:
          errors.UsageError: an argument is unknown or out of range, or torch is not installed.
        """
        errors.choice("arrays", arrays, ARRAYS)
        self._shared = _to_torch() if arrays == "torch" else lambda array: array
        super().__init__(num_envs, **arguments)
        self._ended: Any = jnp.zeros(num_envs, bool)

    def step(self, actions: ArrayLike) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Advances every lane by one control step (1/30 s).

        Args:
          actions: `[N, D]` in [-1, 1], clipped.

        Raises:
          errors.UsageError: actions of another shape.
          gymnasium.error.ResetNeeded: before the first reset.
        """
        if self._lanes is None:
            raise gymnasium.error.ResetNeeded("call reset() before step()")
        if tuple(actions.shape) != self._shape:
            raise errors.UsageError("actions", str(list(self._shape)), list(actions.shape))
        is_foreign = not isinstance(actions, jax.Array | np.ndarray)
        actions = jnp.from_dlpack(actions.detach()) if is_foreign else jnp.asarray(actions)
        idle = jnp.zeros(self.num_envs, bool)
        reset_mask = self._ended if self._mode == AutoresetMode.NEXT_STEP else idle
        autoreset = self._mode == AutoresetMode.SAME_STEP
        do = batch.StepMode(reset_mask, True, autoreset)
        self._lanes, result = self._batch.advance(self._lanes, actions.astype(jnp.float32), do)
        (observed, info), (reward, terminated, truncated) = result.now, result.outcome
        self._ended = terminated | truncated
        if autoreset:
            final = {"final_obs": result.final[0], "final_info": result.final[1]}
            info = {**info, **final, "_final_obs": self._ended, "_final_info": self._ended}
        out = (observed, reward, terminated, truncated, info)
        return jax.tree.map(self._shared, out)

    def _begun(self, now: tuple[Any, Any], which: np.ndarray) -> tuple[Any, dict[str, Any]]:
        self._ended = self._ended & ~jnp.asarray(which)
        return jax.tree.map(self._shared, now)


def _to_torch() -> Callable[[jax.Array], Any]:
    """Returns the conversion of jax's arrays to torch's tensors of the same memory."""
    try:
        return importlib.import_module("torch").from_dlpack
    except ImportError:
        raise errors.UsageError("arrays", "torch to be installed", "no such package") from None
