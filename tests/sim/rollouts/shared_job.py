"""Demonstrations and trials of a stub, as one process of several. Runs nothing on import."""

import functools
import time
from pathlib import Path


def run(out: Path) -> None:
    """Collects into `out/demos` and evaluates into `out/trials`."""
    import jax
    import jax.numpy as jnp
    import numpy as np
    import stubs

    from starjax.data import demos, schema
    from starjax.evaluation import evaluate
    from starjax.evaluation import trials as tables
    from starjax.sim.rollouts import agent
    from starjax.sim.rollouts.placement import DeviceLayout

    env, trocars, layout = stubs.make_env(), stubs.trocars(0, 4, 8), DeviceLayout(lanes=2)
    expert = agent.from_single(stubs.EXPERT)
    settings = schema.DemoSettings(per_trocar=3, seed=0, max_steps=100)
    demos.collect(out / "demos", env, expert, trocars, settings, layout=layout)
    sample, params = stubs.make_policy(width=32)
    found = evaluate.evaluate(
        out / "trials",
        env,
        agent.from_policy(sample, 2, 4),
        (params, jnp.float32(1.0)),
        trocars,
        evaluate.EvaluationSettings(trials=4, seed=0, time_limit_s=1.0, video_trials=3),
        layout=layout,
    )
    np.savez(out / f"table-{jax.process_index()}.npz", **tables.columns(found))


def main(argv: list[str]) -> int:
    """`OUT SLOW_S FAILING`: every part takes so long to write; in one process they fail."""
    import jax

    from starjax.runtime import files, processes

    out, slow_s, failing = Path(argv[0]), float(argv[1]), int(argv[2])
    processes._HEARTBEAT_S = 5
    processes.join()
    written = []

    def write(act, *args):
        written.append(args[0])
        if jax.process_index() == failing and len(written) > 3:
            raise files.StorageError("no space left")
        time.sleep(slow_s)
        act(*args)

    for name in ("write_npz", "commit_directory"):
        setattr(files, name, functools.partial(write, getattr(files, name)))
    run(out)
    return 0


if __name__ == "__main__":
    from starjax import cli, runtime

    runtime.prepare_xla()
    cli.run(main)
