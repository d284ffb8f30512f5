"""Demonstrations of a run: their directory, their collection and the training dataset."""

import functools
import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from starjax.cli import messages, stage_times
from starjax.core import config as config_lib
from starjax.core import errors, sources
from starjax.data import demos, redraw, schema, store, windows
from starjax.data import load as loading
from starjax.evaluation.disturbances import DISTURBANCES, base, parse_levels
from starjax.runtime import hub, precompile, processes
from starjax.sim import env as sim_env
from starjax.sim import registries, task_draws
from starjax.sim.rollouts import agent, episodes, placement, sharing, success_quota, trocars
from starjax.sim.state import Env
from starjax.sim.task import Task
from starjax.training import encoder as encoders
from starjax.training import frozen, randomise
from starjax.training.encoder import Encoder

_FROM, _RANDOMISE = "demos.from_", "demos.randomise"


class DemosWork(NamedTuple):
    """Demonstrations of a run.

    Attributes:
      root: their directory.
      collect: collects the missing ones.
      precompile: begins to compile the programs of `collect`.
    """

    root: Path
    collect: Callable[[], None]
    precompile: Callable[[], None] = lambda: None


def plan(config: config_lib.RunConfig, env: Env, share: sharing.Share) -> DemosWork:
    """Plans the demonstrations of a run; `share` is the run's, because all processes collect."""
    if config.demos.from_:
        root = given(config, env)
        return DemosWork(root, lambda: messages.stage("collect", f"nothing, from {root}"))
    env, max_levels, disturbances = randomised(config, env)
    if config.policy.observation == "image":
        env = sim_env.without_images(env)  # training draws them: collecting waits for no camera
    task, name = env.task, config.demos.expert or next(iter(env.task.experts))
    errors.choice("demos.expert", name, task.experts)
    chosen = trocars.select(task.trocars, slice(config.demos.seen_trocars))
    settings = schema.DemoSettings(
        per_trocar=config.demos.per_trocar,
        seed=config.seed,
        max_steps=max(config.demos.max_steps, task.least_steps),
        keep_failures=config.demos.keep_failures,
        expert=name,
        randomise=max_levels,
        disturbances=disturbances,
    )
    expert = agent.from_single(task.expert(name))
    out = Path(config.out)
    root = store.folder(out, schema.describe(env, chosen, settings))

    def is_there() -> bool:
        if not store.is_sealed(root):
            return False
        try:
            store.read_seal(root)
        except errors.UsageError as error:
            argument = _FROM if config.demos.from_ else error.argument
            raise errors.UsageError(argument, error.expected, error) from error
        except ValueError as error:
            messages.indented(f"damaged, collected again: {error}")
            (root / "SEALED.json").unlink()
            return False
        return True

    attempts = itertools.count()
    compiled: list[Callable[[], None]] = []

    def prepare() -> None:
        if processes.is_alone() and not placement.devices() and not store.is_sealed(root):
            job = functools.partial(demos.precompile, env, expert, chosen, settings)
            compiled.append(precompile.start(job))

    def collect() -> None:
        if share.first(f"collected {next(attempts)}", is_there):
            messages.stage("collect", f"already complete, {root}")
            return
        messages.stage("collect", f"into {root}")
        for wait in compiled:
            wait()
        layout = placement.DeviceLayout(devices=placement.devices())
        try:
            with stage_times.timed(out, f"collect {root.name}"):
                counts = demos.collect(
                    root, env, expert, chosen, settings, layout=layout, report=messages.indented
                )
        except success_quota.ExpertFailed as error:
            if task.name not in registries.tasks.built_in:
                task_draws.require_finite(env.scene)
            raise errors.UsageError(
                "demos.max_steps",
                "enough control steps for the expert",
                settings.max_steps,
                f"{error}; starjax check {task.name} shows the causes",
            ) from error
        messages.indented(
            "{episodes} demonstrations, {trials} trials, {frames} frames".format(**counts)
        )

    return DemosWork(root, collect, prepare)


def size(config: config_lib.RunConfig, task: Task) -> tuple[int, int]:
    """Returns the number of demonstrations that are collected, and the frames to have room for.

    Both are 0 for a dataset that is given.
    """
    if config.demos.from_:
        return 0, 0
    count = config.demos.per_trocar * len(task.is_seen[: config.demos.seen_trocars])
    return count, demos.rows(count, config.demos.max_steps)


def randomised(
    config: config_lib.RunConfig, env: Env
) -> tuple[Any, dict[str, float], tuple[sources.Identity, ...]]:
    """Returns the environment for recording demonstrations, the maximum levels of its
    disturbances as datasets hold them, and their identities.

    Raises:
      errors.UsageError: a disturbance of observations or of measured trocars, or no such level.
    """
    max_levels = parse_levels(_RANDOMISE, config.demos.randomise)
    for name, level in max_levels.items():
        if not _changes_demos(kind := DISTURBANCES.get(name)):
            known = DISTURBANCES.built_in
            works = [other for other in known if _changes_demos(DISTURBANCES.get(other))]
            hint = "" if kind.is_of_motion else f"--train.randomise {name}={level:g} draws it anew"
            raise errors.UsageError(_RANDOMISE, f"one of {', '.join(works)}", name, hint)
        base.check_tools(_RANDOMISE, name, env.names.tools)
        base.check_levels(_RANDOMISE, name, [level])
    if not max_levels:
        return env, {}, ()
    # Datasets hold the names that seed the draws: renamed disturbances leave their digests alone.
    recorded = {base.stream(name): level for name, level in max_levels.items()}
    parts = tuple(sources.identity(DISTURBANCES, name) for name in max_levels)
    return base.with_random_levels(env, max_levels), recorded, parts


def _changes_demos(kind: base.Disturbance) -> bool:
    """Returns True if recorded motions differ by it in a way that a policy can learn from."""
    return kind.for_demos and kind.is_of_motion


def given(config: config_lib.RunConfig, env: Env) -> Path:
    """Returns the directory of --demos.from, if the run can train on that dataset.

    Raises:
      errors.UsageError: it is no dataset, of another task, or without the policy's observation.
    """
    root = hub.dataset("demos.from", config.demos.from_)
    try:
        about = store.read_description(root)
        store.read_seal(root)
        task, features = about["scene"]["task"], about["features"]
        reference = np.array(about["p_world_ref"], np.float32)
    except (KeyError, TypeError, ValueError) as error:
        hint = "starjax import makes one of a dataset in another format (starjax list)"
        raise errors.UsageError(_FROM, "a dataset that is complete", error, hint) from error
    policy, task_hint = config.policy, f"--task {task} trains on it"
    if task != env.task.name:
        raise errors.UsageError(_FROM, f"demonstrations of {env.task.name}", task, task_hint)
    if not np.array_equal(reference, np.asarray(env.p_world_ref, np.float32)):
        expected = f"nominal trocars at {env.p_world_ref.tolist()}"
        raise errors.UsageError(_FROM, expected, reference.tolist())
    size = [policy.image_size, policy.image_size, 3]
    if redrawn := randomise.redrawn_names(config.train):
        hint = f"without {' and '.join(redrawn)} it trains on them"
        redraw.expect_possible(randomise.ARGUMENT, about, hint)
    required = {f"{episodes.IMAGE}{camera}": size for camera in env.names.cameras}
    if policy.observation == "state":
        required = {"state": [sum(field.size for field in env.task.fields)]}
    elif redraw.is_possible(about):
        model = schema.model_hash(env.scene)  # empty without a MuJoCo model
        required = {} if model and about["model"] == model else required
    for name, shape in required.items():
        recorded = features.get(name, {}).get("shape")
        if recorded != shape:
            got = "none" if recorded is None else f"one of {recorded}"
            raise errors.UsageError(_FROM, f"a field {name} of {shape}", f"{got} in {root}")
    return root


def load(
    config: config_lib.RunConfig,
    env: Env,
    root: Path,
    collect: Callable[[], None],
    encoder: Encoder | None,
    share: sharing.Share,
) -> Any:
    """Returns the dataset to train on, with the features of a frozen encoder instead of images."""
    complete(config, root, collect, share)
    draws = env if config.policy.observation == "image" else None
    report = messages.indented
    if draws and encoder is None:
        redraws = randomise.redraws(config.train)
        return loading.load(root, verify=False, env=draws, sources=redraws, report=report).dataset
    _, rows = size(config, env.task)
    loaded = loading.load(root, verify=False, images=encoder is None, rows=rows, report=report)
    if encoder is None:
        return loaded.dataset
    return with_features(config, draws, root, loaded, encoder)


def complete(
    config: config_lib.RunConfig, root: Path, collect: Callable[[], None], share: sharing.Share
) -> None:
    """Collects missing and damaged demonstrations.

    Raises:
      errors.UsageError: those of --demos.from are damaged, or none is a success.
    """

    def is_whole() -> bool:
        try:
            loading.verify(root)
        except store.DamagedEpisode as error:
            if config.demos.from_:
                raise errors.UsageError(_FROM, "demonstrations that are whole", error) from error
            messages.indented(f"damaged, collected again: {error}")
            (root / "SEALED.json").unlink()
            return False
        except errors.UsageError as error:
            argument = _FROM if config.demos.from_ else error.argument
            raise errors.UsageError(argument, error.expected, error) from error
        return True

    collect()
    if not share.first("whole", is_whole):
        collect()


def with_features(
    config: config_lib.RunConfig,
    env: Env | None,
    root: Path,
    loaded: loading.Demos,
    encoder: Encoder,
) -> Any:
    """Returns frames that were loaded without images, with the features of a frozen encoder."""
    dataset = loaded.dataset
    count = int(np.sum(dataset.length))
    # A delayed window may show any frame.
    stride = 1 if config.train.randomise else config.train.window_stride
    rows = windows.observed_frames(dataset, config.policy.obs_horizon, stride)
    with stage_times.timed(Path(config.out), "features"):
        parts = [
            frozen.features(
                encoder,
                config.policy,
                root,
                loaded.digest,
                count,
                camera,
                lambda camera=camera: loading.frames(root, env)[camera],
                messages.indented,
                rows,
            )
            for camera in config.scene.camera
        ]
    rows = len(dataset.episode)
    joined = np.pad(np.concatenate(parts, axis=-1), ((0, rows - count), (0, 0)))
    features = jax.device_put(joined) if windows.on_device(dataset) else joined
    return dataset.replace(observation=dataset.observation._replace(features=features))


def frozen_encoder(policy: config_lib.PolicyConfig) -> Encoder | None:
    """Returns the frozen image encoder, None for other policies.

    Raises:
      errors.UsageError: the weights of an encoder, frozen or not, cannot be used.
    """
    if policy.observation != "image" or not policy.encoder_weights:
        return None
    pretrained = encoders.read(policy)
    return pretrained if policy.freeze_encoder else None
