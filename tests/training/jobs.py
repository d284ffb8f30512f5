"""Training jobs for tests that run them in processes of their own. Runs nothing on import."""

import sys
from pathlib import Path

import fakes

from starjax import config
from starjax.experiments.methods import METHODS

SETTINGS = config.TrainConfig(
    steps=24,
    batch_size=16,
    learning_rate=1e-3,
    warmup_steps=4,
    steps_per_call=6,
    checkpoint_every=4,
    log_every=3,
    holdout_demos=1,
)


def train(directory, settings=SETTINGS, host=False, method="stardiff", **kwargs):
    """A whole training run on fake demonstrations."""
    import jax
    import numpy as np

    from starjax.training import loop

    dataset = fakes.dataset(seed=0)
    if host:
        dataset = jax.tree.map(np.asarray, dataset)
    return loop.run(
        METHODS[method],
        fakes.TINY,
        settings,
        dataset,
        fakes.P_WORLD_REF,
        directory,
        0,
        **kwargs,
    )


def train_and_export(directory: Path) -> None:
    """What `starjax train` does: its last file is the policy."""
    from starjax.training import export

    path = directory / "policy.safetensors"
    if path.exists():
        return
    state = train(directory).state
    export.save(
        path,
        export.Trained("stardiff", fakes.TINY, SETTINGS, state.ema_params, state.normalizer),
    )


def devices_main(count: int, out: str) -> None:
    """Trains on `count` devices; saves the parameters, the frames drawn and the log's losses."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from starjax.data import windows
    from starjax.training import metrics, step

    assert len(jax.devices()) == count
    settings = SETTINGS
    state = train(Path(out) / "run", settings).state
    key_frames, _ = step.step_keys(state.key, 5)
    frames = windows.sample_frames(key_frames, jnp.arange(100), settings.batch_size)
    arrays = {str(i): np.asarray(x) for i, x in enumerate(jax.tree.leaves(state.params))}
    losses = [
        line["loss"] for line in metrics.read(Path(out) / "run/metrics.jsonl") if "loss" in line
    ]
    sizes = {len(x.sharding.device_set) for x in jax.tree.leaves(state.params)}
    assert sizes == {count}
    np.savez(Path(out) / "found.npz", frames=frames, losses=losses, **arrays)


if __name__ == "__main__":
    from starjax import runtime

    runtime.prepare_xla()
    devices_main(int(sys.argv[1]), sys.argv[2])
