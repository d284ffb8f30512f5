"""Runs an agent in closed loop, as one program over a batch of episodes, until all are over.

A trial is named by (trocar, trial). Its key is `fold_in(fold_in(key, trocar), trial)`: one half
resets the environment, the other is the agent's. So a trial's result does not depend on its batch,
device or neighbours. Only the size of the compiled batch may change last bits (of matrix products,
and of the simulator when it is small), so each device always runs equally many lanes, some of them
idle.

The program runs in segments of a fixed number of control steps, which end early when all episodes
are over. While the device runs a segment, the host fetches the records of the one before.
"""

from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import numpy as np

from starjax.rcm.trocar import Trocar
from starjax.sim.rollouts import episodes, fetching, programs
from starjax.sim.rollouts.agent import BatchAgent
from starjax.sim.state import Env


class RolloutSettings(NamedTuple):
    """Settings of trials.

    Attributes:
      seed: of all trials.
      stream: folded into the seed's key if given, for starts of its own with the same seed.
      max_steps: control steps after which a trial is over.
      lanes: N, size of the batch over all devices.
    """

    seed: int
    stream: int | None
    max_steps: int
    lanes: int


class Progress(NamedTuple):
    """After a segment.

    Attributes:
      passed: share of the time limit.
      ended: the episodes that it was the last segment of, on the host.
    """

    passed: float
    ended: list[episodes.Episode]


Run = Callable[[Any, Sequence[episodes.Trial]], Generator[Progress]]


def make(
    env: Env,
    agent: BatchAgent,
    trocars: Trocar,
    settings: RolloutSettings,
    record: episodes.Record,
    devices: Sequence[jax.Device] | None = None,
    levels: Mapping[str, float] | None = None,
) -> Run:
    """Builds the programs, which are compiled once for the same functions.

    Args:
      env: `sim.env.Env`.
      trocars: fields `[C, A]`, on the host.
      devices: that lanes are split over; their number must divide that of the lanes.
      levels: of the environment's disturbances, see `EnvParams`; data, not part of a program.

    Returns:
      run(params, group), which simulates at most `lanes` trials and yields Progress after every
      segment. A caller that needs no more may stop.
    """
    key = _key(settings)
    start, advance = programs.make(env, agent, settings.max_steps, record, devices)
    given = {name: np.float32(level) for name, level in (levels or {}).items()}

    def run(params: Any, group: Sequence[episodes.Trial]) -> Generator[Progress]:
        # Idle lanes fill the batch: one program, and one rounding, for any number of trials.
        carry = start(key, params, _filled(trocars, group, settings.lanes), given)
        running = list(range(len(group)))
        images: dict[int, dict[str, list[np.ndarray]]] = {lane: {} for lane in running}
        others: list[dict[str, np.ndarray]] = []
        # In a thread: on a GPU a call may hold its caller while its loops check their conditions
        # on the host.
        with ThreadPoolExecutor(1) as device:
            # Segment n + 1 runs while the host fetches segment n.
            ahead = device.submit(advance, params, carry, np.int32(0))
            del carry
            for last in range(record.frames, settings.max_steps + record.frames, record.frames):
                carry, records, status = ahead.result()
                drawn = {
                    name: fetching.slices(records.pop(name), running)
                    for name in list(records)
                    if name.startswith(episodes.IMAGE)
                }
                if last < settings.max_steps:
                    # Before anything is waited for. If all are over, it ends at once, unused.
                    ahead = device.submit(advance, params, carry, np.int32(last))
                del carry
                status = jax.device_get(status)  # waits for the segment
                others.append(jax.device_get(records))
                for name, parts in drawn.items():
                    for lane, fetched in zip(running, fetching.fetch(parts), strict=True):
                        images[lane].setdefault(name, []).append(fetched)
                is_last = last >= settings.max_steps  # time is over for all
                over = [lane for lane in running if status["over"][lane] or is_last]
                # Images of finished lanes are no longer fetched: they are most of the bytes.
                running = [lane for lane in running if lane not in over]
                yield Progress(
                    1.0 if not running else last / settings.max_steps,
                    [
                        episodes.assemble(
                            lane,
                            group[lane],
                            trocars,
                            settings.seed,
                            status,
                            others,
                            images.pop(lane),
                        )
                        for lane in over
                    ],
                )
                if not running:
                    return

    return run


def precompile(
    env: Env,
    agent: BatchAgent,
    params: Any,
    trocars: Trocar,
    settings: RolloutSettings,
    record: episodes.Record,
) -> None:
    """Compiles, in the background, the programs that `make` builds for one device.

    The arguments are those of `make`; `params` are arrays or their shapes.
    """
    start, advance = programs.make(env, agent, settings.max_steps, record, None)
    trials = _filled(trocars, [(0, 0)], settings.lanes)
    state = start.prepare(_key(settings), params, trials, {})
    advance.prepare(params, state, np.int32(0))


def _key(settings: RolloutSettings) -> jax.Array:
    key = jax.random.key(settings.seed)
    return key if settings.stream is None else jax.random.fold_in(key, settings.stream)


def _filled(trocars: Trocar, group: Sequence[episodes.Trial], lanes: int) -> programs.Trials:
    """Returns a full batch; repetitions of the first trial, inactive, fill it."""
    index, trial = np.array([*group, *[group[0]] * (lanes - len(group))], np.int32).T
    active = np.arange(lanes) < len(group)  # idle lanes count as over
    return programs.Trials(Trocar(*(field[index] for field in trocars)), index, trial, active)
