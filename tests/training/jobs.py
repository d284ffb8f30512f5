"""Training jobs for tests that run them in processes of their own. Runs nothing on import."""

# pyright: reportArgumentType=false

import dataclasses
import signal
import sys
import time
from pathlib import Path

import fakes

from starjax.core import config
from starjax.core.methods import METHODS

SETTINGS = config.TrainConfig(
    steps=12,
    batch_size=16,
    learning_rate=1e-3,
    warmup_steps=4,
    steps_per_call=6,
    checkpoint_every=4,
    log_every=3,
    holdout_demos=1,
)


def train(
    directory,
    settings=SETTINGS,
    host=False,
    observation="state",
    dtype="float32",
    seed=0,
    demos=0,
    **kwargs,
):
    """A whole training run on fake demonstrations of the seed `demos`."""
    import jax
    import numpy as np

    from starjax.training import loop

    size = fakes.TINY.image_size if observation == "image" else 0
    dataset = fakes.dataset(seed=demos, image_size=size)
    if host:
        dataset = jax.tree.map(np.asarray, dataset)
    return loop.run(
        METHODS["stardiff"],
        dataclasses.replace(fakes.TINY, observation=observation, dtype=dtype),
        settings,
        dataset,
        fakes.TASK,
        directory,
        seed,
        **kwargs,
    )


def train_and_export(directory: Path) -> None:
    """What `starjax train` does, with a policy that compiles at once; its last file is weights."""
    from starjax.policies import policy_file
    from starjax.training import loop

    loop.policies.make = lambda *_: _quadratic_policy()

    path = directory / "policy.safetensors"
    if path.exists():
        return
    state = train(directory).state
    policy_file.save(
        path,
        fakes.trained(params=state.ema_params, normalizer=state.normalizer, train=SETTINGS),
    )


def _quadratic_policy():
    """The next tip position, quadratic in the last, with noise from the step's key."""
    import jax
    import jax.numpy as jnp

    from starjax.core.types import Command
    from starjax.policies.base import Policy

    def say(params, observation):
        p, weights = observation.pose.p[:, -1:], params["learner"]
        return jnp.concatenate([p, p * p], -1) @ weights["a"] + weights["b"]

    def prepare(stats, key, batch):
        noise = 0.001 * jax.random.normal(key, batch.command.pose.p.shape)
        return batch.observation, batch.command.pose.p - noise

    def loss(params, given):
        observation, p = given
        return jnp.mean((say(params, observation) - p) ** 2), {}

    def sample(params, stats, keys, observation, trocar):
        p = jnp.broadcast_to(say(params, observation), (len(keys), 16, 1, 3))
        pose = jax.tree.map(lambda x: x[:, -1:], observation.pose)
        return Command(pose._replace(p=p), observation.gripper[:, -1:])

    def init(key):
        return {"learner": {"a": jax.random.normal(key, (6, 3)), "b": jnp.zeros(3)}}

    return Policy(init, prepare, loss, sample)


def devices_main(count: int, out: str, observation: str, dtype: str) -> None:
    """Trains on `count` devices; saves the parameters and the frames drawn."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from starjax.data import windows
    from starjax.policies.models.kernels import packed_params
    from starjax.training import sharding
    from starjax.training.state import step_keys

    assert len(jax.devices()) == count
    # this small policy has some, as on GPUs
    sharding.LARGE, packed_params.PLATFORMS = 256, {"cpu"}
    settings = dataclasses.replace(SETTINGS, holdout_demos=0)
    state = train(Path(out), settings, observation=observation, dtype=dtype).state
    key = step_keys(state.key, 5).batch
    frames = windows.sample_frames(key, jnp.arange(100), settings.batch_size)
    arrays = {str(i): np.asarray(x) for i, x in enumerate(jax.tree.leaves(state.params))}
    sizes = {len(x.sharding.device_set) for x in jax.tree.leaves(state.params)}
    assert sizes == {count}
    np.savez(Path(out) / "found.npz", frames=frames, **arrays)


def processes_main(out: str, asks: int) -> None:
    """Trains as one process of several; the first stops at its `asks`th question."""
    import itertools

    import jax

    from starjax.policies.models.kernels import packed_params
    from starjax.runtime import processes
    from starjax.training import devices, loop, sharding

    processes.join()
    given = jax.numpy.ones(3)
    spread = devices.replicate(given, devices.make_mesh(2), may_alias=None).addressable_data(0)
    assert spread.unsafe_buffer_pointer() == given.unsafe_buffer_pointer(), "held twice"
    sharding.LARGE, packed_params.PLATFORMS = 18, {"cpu"}  # the matrix, not the vector
    loop.policies.make = lambda *_: _quadratic_policy()
    asked = itertools.count(1)
    try:
        result = train(
            Path(out) / "run", should_stop=lambda: next(asked) == asks and processes.is_first()
        )
    except KeyboardInterrupt as stopped:
        print(stopped)
        return
    save(Path(out) / f"found-{jax.process_index()}.npz", processes.own(result.state))


def feed_main(out: str) -> None:
    """Saves the rows of a streamed batch that one process of several gathers, and their places."""
    import jax
    import numpy as np

    from starjax.runtime import processes

    processes.join()  # before the modules that make a mesh
    import test_batches

    from starjax.training import batches, devices
    from starjax.training.sharding import StateLayout

    mesh = devices.make_mesh(16)
    layout = StateLayout(mesh, lambda params: params, test_batches.NOTHING)
    setup = test_batches.SETUP._replace(layout=layout)
    dataset = jax.tree.map(np.asarray, fakes.dataset(seed=0, demos=2, length=20))
    gathered, gather = [], batches.windows.gather
    batches.windows.gather = lambda d, f, *a: gathered.append(len(f)) or gather(d, f, *a)
    stream = batches.gathered(setup, dataset, np.arange(40), jax.random.key(3), 0)
    found = next(stream).observation.pose.p
    stream.close()
    parts = sorted(found.addressable_shards, key=lambda shard: shard.index[0].start)
    tips = np.concatenate([np.asarray(shard.data) for shard in parts])
    path = Path(out) / f"feed-{jax.process_index()}.npz"
    np.savez(path, tips=tips, rows=devices.own_rows(mesh, 16), gathered=gathered[0])


def run_main(out: str, mode: str) -> None:
    """Is one process of several of `starjax run`: `waits` before it, `trains` without an end until
    it stops, or does the `whole` of a run with a stub of the simulator."""
    import jax
    import stubs

    from starjax import cli
    from starjax.cli import demonstrations, pipeline, policy_evaluation
    from starjax.policies import policy as policies
    from starjax.runtime import processes

    policies.make = lambda *_, **__: _quadratic_policy()
    policy_evaluation.inference_ms = lambda *_: {"p50": 1.0, "p95": 1.0, "p99": 1.0}
    training, stages = SETTINGS, ["collect", "train", "evaluate"]
    if mode == "trains":
        training = dataclasses.replace(SETTINGS, steps=10**6, checkpoint_every=10**6)
        demonstrations.plan = lambda *_: demonstrations.DemosWork(Path(out) / "demos", lambda: None)
        demonstrations.load = lambda *_: fakes.dataset(seed=0)
    pipeline._environment = lambda _: fakes.env() if mode == "trains" else stubs.make_env()
    settings = config.RunConfig(
        out=out,
        policy=dataclasses.replace(fakes.TINY, execute=1),  # more are not planned
        train=training,
        demos=config.DemosConfig(per_trocar=2, seen_trocars=3, max_steps=100),
        eval=config.EvalConfig(trials=2, time_limit_s=1.0),
    )

    def command(argv) -> int:
        processes.join()
        if mode == "waits":
            (Path(out) / f"waits-{jax.process_index()}").touch()
            time.sleep(60)
        pipeline.run(settings, stages, "a test")
        return 0

    # Ignored where the tests were started in the background.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    cli.run(command)


def save(path: Path, state) -> None:
    """The parameters and their averages."""
    import jax
    import numpy as np

    leaves = jax.tree.leaves((state.params, state.ema_params))
    np.savez(path, **{str(i): np.asarray(leaf) for i, leaf in enumerate(leaves)})


if __name__ == "__main__":
    from starjax import runtime

    runtime.prepare_xla()
    if sys.argv[1] == "process":
        processes_main(sys.argv[2], int(sys.argv[3]))
    elif sys.argv[1] == "feed":
        feed_main(sys.argv[2])
    elif sys.argv[1] in ("trains", "waits", "whole"):
        run_main(sys.argv[2], sys.argv[1])
    else:
        devices_main(int(sys.argv[1]), *sys.argv[2:])
