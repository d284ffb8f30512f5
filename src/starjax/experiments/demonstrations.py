"""Demonstrations of a run: where they lie, collecting what is missing, and what training sees.

What brings jax is imported where it is used, after XLA has been prepared.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from starjax import config as config_lib
from starjax import errors
from starjax.experiments import clock, words


def plan(config: config_lib.RunConfig, env: Any) -> tuple[Path, Callable[[], None]]:
    """The folder of a run's demonstrations, and a function that collects what it lacks."""
    from starjax.data import demos, schema, store
    from starjax.rollouts import agent, placement, waves
    from starjax.rollouts import trocars as configurations

    twelve = configurations.twelve(len(env.p_world_ref))
    trocars = configurations.select(twelve, slice(config.demos.seen_trocars))
    wanted = schema.Settings(
        per_trocar=config.demos.per_trocar,
        seed=config.seed,
        max_steps=config.demos.max_steps,
        keep_failures=config.demos.keep_failures,
        expert="one_wall" if config.demos.one_wall else "",
    )
    out = Path(config.out)
    root = out / f"demos-{store.digest(schema.describe(env, trocars, wanted))}"

    def collect() -> None:
        if store.is_sealed(root):
            try:
                store.read_seal(root)
            except ValueError as error:
                words.indented(f"damaged, collected again: {error}")
                (root / "SEALED.json").unlink()
            else:
                words.stage("collect", f"done before, {root}")
                return
        words.stage("collect", f"into {root}")
        expert = agent.from_single(env.task.experts[schema.expert_name(env.task, wanted)]())
        settings = {"place": placement.Place(devices=placement.devices()), "report": words.indented}
        try:
            with clock.timed(out, f"collect {root.name}"):
                found = demos.collect(root, env, expert, trocars, wanted, **settings)
        except waves.ExpertFailed as error:
            raise errors.UsageError(
                "demos.max_steps",
                "enough control steps for the expert",
                config.demos.max_steps,
                str(error),
            ) from error
        words.indented(
            "{episodes} demonstrations, {trials} trials, {frames} frames".format(**found)
        )

    return root, collect


def load(
    config: config_lib.RunConfig, root: Path, collect: Callable[[], None], encoder: Any
) -> Any:
    """The dataset to train on, with what a frozen encoder sees in the place of pictures."""
    from starjax.data import load as loading
    from starjax.data import store

    collect()
    settings = {"images": encoder is None, "report": words.indented}
    try:
        found = loading.load(root, **settings)
    except store.DamagedEpisode as error:
        words.indented(f"damaged, collected again: {error}")
        (root / "SEALED.json").unlink()
        collect()
        found = loading.load(root, **settings)
    return found.dataset if encoder is None else _with_features(config, root, found, encoder)


def _with_features(config: config_lib.RunConfig, root: Path, demos: Any, encoder: Any) -> Any:
    import jax

    from starjax.data import load as loading
    from starjax.data import windows
    from starjax.training import frozen

    dataset = demos.dataset
    with clock.timed(Path(config.out), "features"):
        found = frozen.features(
            encoder,
            config.policy,
            config.train,
            root,
            demos.digest,
            len(dataset.episode),
            lambda: loading.frames(root),
            words.indented,
        )
    features = jax.device_put(found) if windows.on_device(dataset) else found
    return dataset.replace(observation=dataset.observation.replace(features=features))


def frozen_encoder(config: config_lib.RunConfig) -> Any:
    """The vision encoder that stays frozen, None for other runs; mistakes are found here."""
    if config.policy.observation != "image" or not config.policy.encoder_weights:
        return None
    from starjax.training import encoder

    found = encoder.read(config.policy, config.train)
    return found if config.policy.freeze_encoder else None
