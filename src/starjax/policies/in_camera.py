"""A policy that sees and plans in the endoscope's frame: another one, with its frame changed."""

import jax

from starjax import rcm
from starjax.data import frames, normalizer, windows
from starjax.policies.base import Params, Policy
from starjax.sim.tasks.base import Task
from starjax.types import Command, Observation, Pose


def make(policy: Policy, task: Task) -> Policy:
    """Turns what a policy sees into the endoscope's frame, and its commands into the world's.

    The frame is that of the time of a decision.

    Args:
      policy: to be asked in that frame. Its statistics are of it too, see `normalizer.fit`.
      task: one that has an endoscope.
    """

    def prepare(stats: normalizer.Normalizer, key: jax.Array, batch: windows.Batch):
        camera = _now(batch.observation)
        turned = batch.replace(
            observation=frames.observation(task, camera, batch.observation),
            command=frames.command(camera, batch.command),
            trocar=frames.trocar(task, camera, batch.trocar),
        )
        return policy.prepare(stats, key, turned)

    def sample(
        params: Params,
        stats: normalizer.Normalizer,
        keys: jax.Array,
        observation: Observation,
        trocar: rcm.TrocarFrame,
    ) -> Command:
        camera = _now(observation)
        seen = frames.observation(task, camera, observation)
        planned = policy.sample(params, stats, keys, seen, frames.trocar(task, camera, trocar))
        return planned._replace(pose=frames.outward(camera, planned.pose))

    return policy._replace(prepare=prepare, sample=sample)


def _now(observation: Observation) -> Pose:
    """The endoscope's poses `[B]` at the last moment of `[B, O]`."""
    return jax.tree.map(lambda leaf: leaf[:, -1], frames.of(observation))
