"""Success of the dial's two experts by the turn of the needle, at the task's trocars and others.

    python experiments/wrist/dial/turns.py [--expert default] [--per-trocar 60] [--sampled 600] \\
        [--seed 2026] [--c] [--tiny]

The task is needle drive along the dial. One expert (`default`) drives each needle in a plane that
suits the trocar, the other (`one_plane`) in one plane for all. A second column has the
episodes whose wrist stays within its limits in that plane, in closed form.
"""

import argparse
import pathlib
import sys

sys.path.append(str(pathlib.Path(__file__).parents[3] / "benchmarks"))
import _c_env
import _timing
import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm, runtime
from starjax.addons.suture.needle_drive import dial
from starjax.evaluation import expert as runs
from starjax.sim import env as envs
from starjax.sim import sampling

STEPS = 600  # control steps, 20 s


def main() -> None:
    runtime.prepare_xla()
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--expert", choices=tuple(dial.TASK.experts), default="default")
    parser.add_argument("--per-trocar", type=int, default=60)
    parser.add_argument("--sampled", type=int, default=600)
    parser.add_argument("--seed", type=int, default=2026)
    parser.add_argument("--c", action="store_true", help="C MuJoCo's physics instead of ours")
    parser.add_argument("--tiny", action="store_true", help="an episode each, nothing written")
    asked = parser.parse_args()
    environment = envs.make(dial.TASK.name, observation="state")
    if asked.c:
        environment = _c_env.with_c_physics(environment)
    each, drawn = (1, 2) if asked.tiny else (asked.per_trocar, asked.sampled)
    task, key = environment.task, jax.random.key(asked.seed)
    twelve = rcm.Trocar(*(jnp.repeat(jnp.asarray(f), each, axis=0) for f in task.trocars))
    is_seen = np.repeat(task.is_seen, each)
    others = sampling.sample_trocars(jax.random.fold_in(key, 1), task, (drawn,))
    at_twelve, at_others = (
        runs.run(environment, task.expert(asked.expert), at, jax.random.fold_in(key, k), STEPS)
        for k, at in ((2, twelve), (3, others))
    )
    leans = dial.LEANS if asked.expert == "default" else np.array([dial.LEAN], np.float32)
    found = {
        "seen": _by_turn(at_twelve, leans, is_seen),
        "unseen": _by_turn(at_twelve, leans, ~is_seen),
        "others": _by_turn(at_others, leans, np.ones(drawn, bool)),
    }
    print(found, flush=True)
    sizes = {"seed": asked.seed, "physics": "C MuJoCo" if asked.c else "ours"}
    _timing.report(f"turns_{asked.expert}", {**sizes, "turns": found}, asked.tiny)


def _by_turn(
    episodes: runs.ExpertEpisodes, leans: np.ndarray, chosen: np.ndarray
) -> list[list[int]]:
    """Returns (successes, within the wrist's limits, episodes) of each bin of the dial."""
    layout, trocar = episodes.last.layout, episodes.last.trocar.p_world_trocar[:, 0]
    each = jax.vmap(dial.margin, (None, None, 0))
    margins = jax.jit(jax.vmap(each, (0, 0, None)))(layout.bite, trocar, jnp.asarray(leans))
    served, success = np.asarray(margins).max(1) > 0, np.asarray(episodes.last.success)
    turn = np.asarray(jax.vmap(dial.label)(layout)["turn"])
    bins = [chosen & (turn == k) for k in range(dial.BINS)]
    return [[int(success[rows].sum()), int(served[rows].sum()), int(rows.sum())] for rows in bins]


if __name__ == "__main__":
    main()
