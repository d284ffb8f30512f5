"""Episodes of a policy of `onestep` at the seen trocars, from new starts and from failed ones."""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from starjax.addons.finetune import dagger, explore, noise_level
from starjax.addons.finetune.commands.finetune_work import Work
from starjax.core import config, errors
from starjax.core.types import ArrayTree
from starjax.evaluation import statistics
from starjax.policies import features, generator
from starjax.policies.base import Policy
from starjax.rcm.trocar import Trocar
from starjax.sim.rollouts import trocars as configurations

LIMIT = 1.5  # times the slowest 5% of successes, after which an episode has failed
AGAIN = 0.5  # share of a batch's episodes whose starts failed in the one before


class PolicyParams(NamedTuple):
    """Parameters of a policy: `params` without those of the encoder `vision`; its normaliser."""

    params: Any
    vision: Any
    stats: Any


class NoisyEpisodes:
    """The program of a batch of episodes, and its starts."""

    def __init__(self, work: Work, policy: Policy, steps: np.ndarray):
        """Builds it; `steps` `[n]` are the control steps of the policy's successes."""
        if not len(steps):
            raise errors.UsageError("RUN", "a policy with some success", "none in validation")
        env, settings = work.base.env, work.config.policy
        limits, _ = dagger.limits(steps, env.control_hz, env.task.stalled_s)
        self.settings = explore.ExploreSettings(
            settings.obs_horizon,
            settings.execute,
            math.ceil(LIMIT * limits.clock / settings.execute),
        )
        see = _make_see(settings) if settings.observation == "image" else None
        self._play = explore.make(env, policy, see, env.names.cameras, self.settings)
        self._count, self._noise = work.settings.episodes, work.settings.noise
        self._trocars = configurations.listed(work.seen, len(env.p_world_ref))

    def prepare(self, who: PolicyParams) -> Any:
        """Begins to compile the program; returns the shapes of an `explore.Experience`."""
        keys = jax.random.key(0), jax.random.key(0)
        none_failed, draws = np.zeros((0, 2), np.int32), np.random.default_rng(0)
        noise = np.zeros(self._count, np.float32)
        return self._play.prepare(*who, self.starts(0, none_failed, draws), *keys, noise)

    def play(
        self, who: PolicyParams, starts: explore.Starts, keys: tuple[Any, Any], noise: ArrayLike
    ) -> explore.Experience:
        """Plays a batch; `keys` of the starts and of the noise, see `explore.make`."""
        several = np.broadcast_to(np.asarray(noise, np.float32), (self._count,))
        return self._play(*who, starts, *keys, several)

    def probe(self, who: PolicyParams, number: int, keys: tuple[Any, Any]) -> list[dict[str, Any]]:
        """Returns success rates at several levels of noise, from the starts of batch `number`."""
        none_failed, draws = np.zeros((0, 2), np.int32), np.random.default_rng(number)
        starts, level = noise_level.repeated(self.starts(number, none_failed, draws))
        noise = self._noise * np.array(noise_level.LEVELS)
        success = np.asarray(self.play(who, starts, keys, noise[level]).success)
        return [
            {"noise": float(deviation), **statistics.rate(success[level == n])}
            for n, deviation in enumerate(noise)
        ]

    def starts(self, number: int, failed: np.ndarray, draws: np.random.Generator) -> explore.Starts:
        """Returns the starts of batch `number`, some of them of those `[M, 2]` that failed."""
        count = self._count
        index = np.arange(count, dtype=np.int32) % len(self._trocars.radius)
        trial = number * count + np.arange(count, dtype=np.int32)
        if len(failed):
            old = np.arange(int(AGAIN * count))
            index[old], trial[old] = failed[draws.integers(len(failed), size=len(old))].T
        fields = Trocar(*(np.asarray(field)[index] for field in self._trocars))
        return explore.Starts(fields, index, trial)


def _make_see(policy_config: config.PolicyConfig) -> explore.See:
    """Returns the encoder on centre crops, as inference sees them."""
    vision = generator.vision_encoder(policy_config)

    def see(params: ArrayTree, images: jax.Array) -> jax.Array:
        return jnp.asarray(vision.apply(params, features.centre_crop(policy_config, images)))

    return see
