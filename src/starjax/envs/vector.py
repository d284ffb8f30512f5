"""Batch of Gymnasium environments, simulated by one compiled program."""

from collections.abc import Sequence
from typing import Any

import gymnasium
import jax
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from jax.typing import ArrayLike

from starjax.core import errors
from starjax.core.types import ArrayTree
from starjax.envs import batch, forked, observing, settings

METADATA = {"render_modes": ["rgb_array"], "render_fps": 30}


class TaskVectorEnv(gymnasium.vector.VectorEnv):
    """N episodes of a task side by side.

    Lane i of `reset(seed=s)` goes through the same episodes as one environment of seed s + i.

    Attributes:
      episodes: the pure functions of one episode, see `mdp.Episodes`.
      settings: validated settings.
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        **arguments: Any,
    ) -> None:
        """Makes the environments; the first reset compiles their program.

        Args:
          num_envs: N.
          autoreset_mode: treatment of a lane whose episode is over. NEXT_STEP: the next step starts
            another one, ignoring the action. SAME_STEP: the same step does, and
            `info["final_obs"]` and `info["final_info"]` belong to the ended episode. DISABLED: the
            lane is frozen until `reset(options={"reset_mask": mask})`.
          render_mode: `rgb_array` or None.
          arguments: see `settings.EnvSettings`.

        Raises:
          errors.UsageError: an argument is unknown or out of range.
        """
        if num_envs < 1:
            raise errors.UsageError("num_envs", "1 or more", num_envs)
        errors.choice("render_mode", str(render_mode), ["None", *METADATA["render_modes"]])
        self.settings = settings.make(**arguments)
        self.render_mode = render_mode
        self._mode = AutoresetMode(autoreset_mode)
        self.metadata = {**METADATA, "autoreset_mode": self._mode}
        self._batch = self._programs(num_envs)
        self.episodes = self._batch.episodes
        self.num_envs = num_envs
        self.single_action_space = spaces.Box(-1.0, 1.0, (self.episodes.action_size,), np.float32)
        self.single_observation_space = _space(self._batch.observed)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._shape = (num_envs, self.episodes.action_size)
        self._lanes: batch.Lanes | None = None
        self._over = np.zeros(num_envs, bool)

    def _programs(self, num_envs: int) -> batch.EpisodeBatch:
        """Returns the compiled batch; subclasses have others."""
        return batch.make(self.settings, num_envs)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Begins episodes.

        Args:
          seed: of lane 0, with seed + i for lane i; or one per lane; or None to continue every lane
            with its next episode.
          options: `reset_mask`, `[N]` bool, the lanes to reset; all by default.

        Raises:
          errors.UsageError: seeds or mask are not of N lanes, a seed has more than 32 bits, an
            option is unknown, or a mask comes before all lanes have begun.
          gymnasium.error.Error: this process was forked after jax had started.
        """
        try:
            forked.refuse()
        except errors.UsageError as error:
            # A vector environment raises the worker's exception anew, from its text.
            raise gymnasium.error.Error(str(error)) from None
        seeds = self._seeds(seed)
        check_options(options, "reset_mask")
        super().reset(seed=seeds[0] if isinstance(seed, int | np.integer) else None)
        which = np.ones(self.num_envs, bool)
        if options and "reset_mask" in options:
            which = self._mask(options["reset_mask"])
        if self._lanes is None:
            drawn = self.np_random.integers(2**31, size=self.num_envs).astype(np.uint32)
            self._lanes = batch.seeded(self._batch.empty(), drawn, which)
        is_new = np.array([each is not None for each in seeds]) & which
        if is_new.any():
            numbers = np.array([each or 0 for each in seeds], np.uint32)
            self._lanes = batch.seeded(self._lanes, numbers, is_new)
        idle = np.zeros(self._shape, np.float32)
        self._lanes, result = self._batch.advance(
            self._lanes, idle, batch.StepMode(which, False, False)
        )
        return self._begun(result.now, which)

    def _begun(self, now: tuple[Any, Any], which: np.ndarray) -> tuple[Any, dict[str, Any]]:
        """Returns observations and info of a reset of the lanes `which`."""
        self._over = self._over & ~which
        observed, measured = _to_host(now)
        return observed, _info(measured, which)

    def step(
        self, actions: ArrayLike
    ) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Advances every lane by one control step (1/30 s).

        Args:
          actions: `[N, D]` in [-1, 1], clipped.

        Raises:
          errors.UsageError: actions of another shape, or not finite.
          gymnasium.error.ResetNeeded: before the first reset.
        """
        if self._lanes is None:
            raise gymnasium.error.ResetNeeded("call reset() before step()")
        actions = np.asarray(actions, np.float32)
        if actions.shape != self._shape:
            raise errors.UsageError("actions", str(list(self._shape)), list(actions.shape))
        if not np.isfinite(actions).all():
            raise errors.UsageError("actions", "finite numbers", "NaN or infinity")
        is_next_step = self._mode == AutoresetMode.NEXT_STEP
        reset_mask = self._over if is_next_step else np.zeros(self.num_envs, bool)
        autoreset = self._mode == AutoresetMode.SAME_STEP
        do = batch.StepMode(reset_mask, True, autoreset)
        self._lanes, result = self._batch.advance(self._lanes, actions, do)
        now, (reward, terminated, truncated) = _to_host((result.now, result.outcome))
        observed, measured = now
        self._over = terminated | truncated
        info = _info(measured, np.ones(self.num_envs, bool))
        if autoreset and self._over.any():
            info |= self._final(_to_host(result.final), self._over)
        return observed, reward.astype(np.float64), terminated, truncated, info

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Renders the first camera of every lane, `[h, w, 3]` uint8."""
        if self.render_mode is None or self._lanes is None:
            return None
        return tuple(np.array(self._batch.camera(self._lanes.state)))

    def _seeds(self, seed: Any) -> list[int | None]:
        if seed is None:
            return [None] * self.num_envs
        if np.ndim(seed) == 0:
            return [checked_seed(seed, i) for i in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise errors.UsageError("seed", f"one or {self.num_envs} of them", len(seed))
        return [None if each is None else checked_seed(each) for each in seed]

    def _mask(self, mask: ArrayLike | None) -> np.ndarray:
        mask = np.asarray(mask)
        if mask.shape != (self.num_envs,) or mask.dtype != bool or not mask.any():
            expected = f"[{self.num_envs}] bool, some of them true"
            raise errors.UsageError("reset_mask", expected, f"{mask.dtype}{list(mask.shape)}")
        if self._lanes is None and not mask.all():
            raise errors.UsageError("reset_mask", "all lanes at the first reset", "some")
        return mask

    def _final(self, ended: tuple[Any, dict], over: np.ndarray) -> dict[str, Any]:
        """Returns Gymnasium's entries of `info` for episodes that ended in this step."""
        observed, measured = ended
        rows = np.full(self.num_envs, None, object)
        for lane in np.flatnonzero(over):
            rows[lane] = jax.tree.map(lambda x, i=lane: x[i].copy(), observed)
        info = {"final_obs": rows, "final_info": _info(measured, over)}
        return info | {f"_{name}": over.copy() for name in info}


def checked_seed(seed: Any, lane: int = 0) -> int:
    """Returns the seed of a lane; a key of jax has 32 bits, where larger ones would alias others.

    Raises:
      errors.UsageError: it is no whole number from 0 to 2**32 - 1.
    """
    is_whole = isinstance(seed, int | np.integer) and not isinstance(seed, bool)
    if not is_whole or not 0 <= seed + lane < 2**32:
        expected = "a whole number from 0 to 2**32 - 1" + f" - {lane} for lane {lane}" * bool(lane)
        raise errors.UsageError("seed", expected, repr(seed))
    return int(seed) + lane


def check_options(options: dict[str, Any] | None, *known: str) -> None:
    """Raises UsageError for the first option of a reset that is not known."""
    for name in options or {}:
        if name not in known:
            raise errors.UsageError("options", ", ".join(known) or "none", repr(name))


def _space(observed: Any) -> spaces.Space:
    if isinstance(observed, dict):
        return spaces.Dict({name: _space(x) for name, x in observed.items()})
    if observed.dtype == np.uint8:
        return spaces.Box(0, 255, observed.shape, np.uint8)
    return spaces.Box(-observing.LARGEST, observing.LARGEST, observed.shape, np.float32)


def _info(measured: dict[str, np.ndarray], which: np.ndarray) -> dict[str, np.ndarray]:
    """Returns Gymnasium's info of some lanes, with masks and zeros for the others."""
    masks = {f"_{name}": which.copy() for name in measured}
    return {name: np.where(which, x, np.zeros_like(x)) for name, x in measured.items()} | masks


def _to_host(tree: ArrayTree) -> Any:
    """Copies to writable arrays on the host."""
    return jax.tree.map(np.array, jax.device_get(tree))
