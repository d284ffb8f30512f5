"""Runs an agent in closed loop, as one program over a batch of episodes, until all are over.

A trial is named by (trocar, trial). Its key is `fold_in(fold_in(key, trocar), trial)`: one half
resets the environment, the other is the agent's. So a trial does not know in which batch, on which
device or beside whom it runs. Only the size of the compiled batch may change last bits (of matrix
products, and of the simulator when it is small), so each device always runs equally many, some of
them idle if there are fewer.

The program runs in segments of a fixed number of control steps, which end early when all episodes
are over. While the device runs a segment, the host fetches what the one before recorded.
"""

import functools
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from starjax.rcm.trocar import Trocar
from starjax.rollouts import episodes, fetching, placement
from starjax.rollouts.agent import BatchAgent
from starjax.types import Command


class Settings(NamedTuple):
    """How trials are run.

    Attributes:
      seed: of all trials.
      stream: folded into the seed's key if given, so that others with this seed start otherwise.
      max_steps: control steps after which a trial is over.
      lanes: N, size of the batch over all devices.
    """

    seed: int
    stream: int | None
    max_steps: int
    lanes: int


class Trials(NamedTuple):
    """N trials.

    Attributes:
      trocar: fields `[N, A]`.
      index: `[N]` int32 of the trocars' configuration.
      trial: `[N]` int32.
      wanted: `[N]` bool; the others only fill up the batch.
    """

    trocar: Trocar
    index: Any
    trial: Any
    wanted: Any


class Carry(NamedTuple):
    """N trials under way: EnvState, the agent's memory, `[N]` int32 control steps taken, and
    whether they are wanted."""

    env: Any
    memory: Any
    length: jax.Array
    wanted: jax.Array


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
    env: Any,
    agent: BatchAgent,
    trocars: Trocar,
    settings: Settings,
    record: episodes.Record,
    devices: Sequence[jax.Device] | None = None,
    levels: Mapping[str, float] | None = None,
) -> Run:
    """Builds the programs, which are compiled once for the same functions.

    Args:
      env: `sim.env.Env`.
      trocars: fields `[C, A]`, on the host.
      devices: that lanes are split over; their number must divide that of the lanes.
      levels: of what disturbs the environment, see `EnvParams`; data, not part of a program.

    Returns:
      run(params, group), which simulates at most `lanes` trials and yields Progress after every
      segment. A caller that needs no more may stop.
    """
    key = _key(settings)
    start, advance = _made(env, agent, settings, record, devices)
    given = {name: np.float32(level) for name, level in (levels or {}).items()}

    def run(params: Any, group: Sequence[episodes.Trial]) -> Generator[Progress]:
        carry = start(key, params, _filled(trocars, group, settings.lanes), given)
        running = list(range(len(group)))
        images: dict[int, dict[str, list[np.ndarray]]] = {lane: {} for lane in running}
        others: list[dict[str, np.ndarray]] = []
        # In a thread: on a GPU a call may hold its caller while its loops ask the host whether to
        # go on.
        with ThreadPoolExecutor(1) as device:
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
                status = jax.device_get(status)
                others.append(jax.device_get(records))
                for name, parts in drawn.items():
                    for lane, fetched in zip(running, fetching.fetch(parts), strict=True):
                        images[lane].setdefault(name, []).append(fetched)
                is_last = last >= settings.max_steps
                over = [lane for lane in running if status["over"][lane] or is_last]
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


def compile_ahead(
    env: Any,
    agent: BatchAgent,
    params: Any,
    trocars: Trocar,
    settings: Settings,
    record: episodes.Record,
) -> None:
    """Compiles what `make` makes for one device, so that jax's cache on disk has it.

    The arguments are `make`'s, but for `params`: arrays like those to come, or their shapes.
    """
    start, advance = _made(env, agent, settings, record, None)
    begun = start.lower(_key(settings), params, _filled(trocars, [(0, 0)], settings.lanes), {})
    advance.lower(params, begun.out_info, np.int32(0)).compile()
    begun.compile()


def _key(settings: Settings) -> jax.Array:
    key = jax.random.key(settings.seed)
    return key if settings.stream is None else jax.random.fold_in(key, settings.stream)


def _made(
    env: Any,
    agent: BatchAgent,
    settings: Settings,
    record: episodes.Record,
    devices: Sequence[jax.Device] | None,
) -> tuple[Callable[..., Carry], Callable[..., Any]]:
    """Programs that begin a batch of trials, and run a segment of it."""
    world = _World(env.reset, env.step, env.observe, env.labels)
    mind = _Mind(agent.init, agent.act)
    return _programs(
        world, mind, settings.max_steps, record, None if devices is None else tuple(devices)
    )


def _filled(trocars: Trocar, group: Sequence[episodes.Trial], lanes: int) -> Trials:
    """A full batch: the first trial repeats, unwanted, where there are too few."""
    index, trial = np.array([*group, *[group[0]] * (lanes - len(group))], np.int32).T
    wanted = np.arange(lanes) < len(group)
    return Trials(Trocar(*(field[index] for field in trocars)), index, trial, wanted)


class _World(NamedTuple):
    """The functions of an `Env` that programs call: what they are known by."""

    reset: Callable[..., Any]
    step: Callable[..., Any]
    observe: Callable[..., Any]
    labels: Callable[..., Any]


class _Mind(NamedTuple):
    """The same of a `BatchAgent`."""

    init: Callable[..., Any]
    act: Callable[..., Any]


@functools.lru_cache(maxsize=4)
def _programs(
    env: _World,
    agent: _Mind,
    max_steps: int,
    record: episodes.Record,
    devices: Sequence[jax.Device] | None,
) -> tuple[Callable[..., Carry], Callable[..., Any]]:
    """Programs that start trials and advance them."""
    shared, lane = placement.SHARED, placement.LANE
    start = placement.split(_starter(env, agent), devices, (shared, shared, lane, shared), lane)
    advance = placement.split(
        _advancer(env, agent, max_steps, record), devices, (shared, lane, shared), lane, donate=(1,)
    )
    return start, advance


def _starter(env: _World, agent: _Mind) -> Callable[..., Carry]:
    # Imported here, as only programs need it: reading a dataset does not load the simulator.
    from starjax.sim import env as sim_env

    def start_one(key: jax.Array, trials: Trials, levels: Any) -> tuple[Any, jax.Array]:
        key = jax.random.fold_in(jax.random.fold_in(key, trials.index), trials.trial)
        key_env, key_agent = jax.random.split(key)
        return env.reset(key_env, sim_env.EnvParams(trials.trocar, levels=levels)), key_agent

    def start(key: jax.Array, params: Any, trials: Trials, levels: Any) -> Carry:
        state, keys = jax.vmap(start_one, in_axes=(None, 0, None))(key, trials, levels)
        memory = agent.init(params, keys, state, lambda: jax.vmap(env.observe)(state))
        return Carry(state, memory, jnp.zeros(trials.wanted.shape, jnp.int32), trials.wanted)

    return start


def _advancer(
    env: _World, agent: _Mind, max_steps: int, record: episodes.Record
) -> Callable[..., Any]:
    observe, step_all = jax.vmap(env.observe), jax.vmap(env.step)

    def step(params: Any, carry: Carry, t: jax.Array) -> tuple[Carry, dict[str, jax.Array]]:
        before = carry.env
        observed = observe(before) if record.observes else None
        look = (lambda: observe(before)) if observed is None else lambda: observed
        executed, memory, label = agent.act(params, carry.memory, before, look, t)
        after = step_all(before, executed)
        fields = record.fields(episodes.Step(observed, label, executed, before, after))
        return Carry(after, memory, carry.length + ~before.done, carry.wanted), fields

    def advance(params: Any, carry: Carry, first: jax.Array) -> Any:
        """Control steps `first` up to `first + record.frames`, fewer when all episodes are over.

        Returns the carry, records `[N, record.frames]`, and the status `[N]`.
        """
        shapes = jax.eval_shape(lambda state: _fields(env, record, state), carry.env)
        blank = jax.tree.map(
            lambda s: jnp.zeros((s.shape[0], record.frames, *s.shape[1:]), s.dtype), shapes
        )
        last = jnp.minimum(first + record.frames, max_steps)

        def is_running(loop):
            t, carry, _ = loop
            return (t < last) & jnp.any(carry.wanted & ~carry.env.done)

        def body(loop):
            t, carry, records = loop
            carry, fields = step(params, carry, t)
            # In place: not `.at[:, i].set`, a scatter, which may move the whole of the images.
            put = functools.partial(jax.lax.dynamic_update_index_in_dim, index=t - first, axis=1)
            return t + 1, carry, jax.tree.map(put, records, fields)

        _, carry, records = jax.lax.while_loop(is_running, body, (first, carry, blank))
        return carry, records, status(env, carry)

    return advance


def _fields(env: Any, record: episodes.Record, state: Any) -> dict[str, jax.Array]:
    """Records N episodes that stand still, for the shapes."""
    observed = jax.vmap(env.observe)(state) if record.observes else None
    command = Command(state.pose, state.gripper)
    return record.fields(episodes.Step(observed, command, command, state, state))


def frame(env: Any, record: episodes.Record) -> dict[str, jax.ShapeDtypeStruct]:
    """Shapes of one recorded control step, without computing anything."""
    from starjax.sim import env as sim_env

    def one(key: jax.Array) -> dict[str, jax.Array]:
        zeros = jnp.zeros(np.shape(env.p_world_ref)[0])
        state = env.reset(key, sim_env.EnvParams(Trocar(zeros, zeros, zeros)))
        batch = jax.tree.map(lambda x: jnp.asarray(x)[None], state)
        return jax.tree.map(lambda x: x[0], _fields(env, record, batch))

    return jax.eval_shape(one, jax.random.key(0))


def status(env: Any, carry: Carry) -> dict[str, Any]:
    """How N episodes stand: `over`, `length`, `episodes.FLAGS`, `stage`, `labels`, `[N]` each."""
    state = carry.env
    found = {
        "over": state.done,
        "length": carry.length,
        "success": state.success & ~state.invalid,
        "loose": state.loose & ~state.invalid,
        "invalid": state.invalid,
        "collided": state.collided,
        "lost": state.lost,
        "stage": state.stage,
        "labels": jax.vmap(env.labels)(state),
    }
    # Copied, as the next segment is given the carry's memory before the host has read this.
    return jax.tree.map(jnp.copy, found)
