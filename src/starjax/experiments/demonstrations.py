"""Demonstrations of a run: where they lie, collecting what is missing, and what training sees.

What brings jax is imported where it is used, after XLA has been prepared.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from starjax import config as config_lib
from starjax import errors
from starjax.experiments import messages, stage_times


def plan(config: config_lib.RunConfig, env: Any) -> tuple[Path, Callable[[], None]]:
    """The folder of a run's demonstrations, and a function that collects what it lacks."""
    from starjax import rcm
    from starjax.data import demos, store
    from starjax.rollouts import chunks, placement, recording
    from starjax.sim.tasks.peg_transfer import expert

    trocars = rcm.Trocar(*(field[: config.demos.seen_trocars] for field in rcm.TROCARS))
    wanted = {
        "per_trocar": config.demos.per_trocar,
        "seed": config.seed,
        "max_steps": config.demos.max_steps,
        "keep_failures": config.demos.keep_failures,
        "one_wall": config.demos.one_wall,
    }
    init = expert.init_with_one_wall if config.demos.one_wall else expert.init
    script = recording.Expert(init, expert.act)
    out = Path(config.out)
    root = out / f"demos-{store.digest(demos.describe(env, trocars, **wanted))}"

    def collect() -> None:
        if store.is_sealed(root):
            try:
                store.read_seal(root)
            except ValueError as error:
                messages.indented(f"damaged, collected again: {error}")
                (root / "SEALED.json").unlink()
            else:
                messages.stage("collect", f"done before, {root}")
                return
        messages.stage("collect", f"into {root}")
        settings = {"devices": placement.devices(), "report": messages.indented, **wanted}
        try:
            with stage_times.timed(out, f"collect {root.name}"):
                found = demos.collect(root, env, script, trocars, **settings)
        except chunks.ExpertFailed as error:
            raise errors.UsageError(
                "demos.max_steps",
                "enough control steps for the expert",
                config.demos.max_steps,
                str(error),
            ) from error
        messages.indented(
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
    settings = {"pictures": encoder is None, "report": messages.indented}
    try:
        found = loading.load(root, **settings)
    except store.DamagedEpisode as error:
        messages.indented(f"damaged, collected again: {error}")
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
    with stage_times.timed(Path(config.out), "features"):
        found = frozen.features(
            encoder,
            config.policy,
            root,
            demos.digest,
            len(dataset.episode),
            "camera",
            lambda: loading.frames(root),
            messages.indented,
        )
    features = jax.device_put(found) if windows.on_device(dataset) else found
    return dataset.replace(observation=dataset.observation._replace(features=features))


def frozen_encoder(config: config_lib.RunConfig) -> Any:
    """The vision encoder that stays frozen, None for other runs; mistakes are found here."""
    if config.policy.observation != "image" or not config.policy.encoder_weights:
        return None
    from starjax.training import encoder

    found = encoder.read(config.policy)
    return found if config.policy.freeze_encoder else None
