"""The program that demonstrations come from: expert and environment in step, everything recorded.

It runs in segments of a fixed number of control steps: that bounds the memory of recorded pictures
on the device, and a segment ends early when all of its episodes are over. While the device runs a
segment, the host fetches the pictures of the one before.
"""

import functools
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from starjax.rcm.trocar import Trocar
from starjax.rollouts import episodes, placement
from starjax.sim.types import Observation
from starjax.types import Command

SEGMENT = 16  # control steps between two looks at the host
# Demonstrations never start from the states that an evaluation with the same seed draws.
STREAM = 0x64656D6F

FIELDS = {
    "p": "m, measured tip position, world frame",
    "R": "measured tip rotation R_world_tip",
    "gripper": "measured opening, -1 closed to +1 open",
    "image": "uint8 RGB",
    "state": "block position (m), block 6-D rotation, target peg position (m), world frame",
    "command_p": "m, commanded tip position, world frame",
    "command_R": "commanded R_world_tip",
    "command_gripper": "-1 squeeze to +1 open",
    "qpos": "generalised coordinates of the model, before the command",
    "rcm_error": "m, executed by the command",
}


class Expert(NamedTuple):
    """A scripted demonstrator, as single-sample pure functions.

    Attributes:
      init: (key, EnvState) -> expert state.
      act: (expert state, EnvState) -> (Command to execute, expert state); the state's `label`, if
        it has one, is the Command that is recorded.
    """

    init: Callable[..., Any]
    act: Callable[..., Any]


class _Trials(NamedTuple):
    """N trials: `trocar` of fields `[N]`, `index` `[N]` of that trocar, `trial` `[N]`."""

    trocar: Trocar
    index: Any
    trial: Any


class _Carry(NamedTuple):
    """N episodes under way: `length` `[N]` control steps so far, `wanted` `[N]` bool."""

    env: Any
    expert: Any
    length: jax.Array
    wanted: jax.Array


def simulator(
    env: Any,
    expert: Any,
    trocars: Trocar,
    seed: int,
    max_steps: int,
    chunk: int,
    devices: Sequence[jax.Device] | None,
) -> Callable[[list[tuple[int, int]]], Generator[list[episodes.Episode]]]:
    """The compiled programs: from a group of (trocar, trial) to its episodes, as they end.

    What is returned yields, after every segment, the episodes that it was the last one of, on the
    host; a caller that needs no more of them may stop.
    """
    key = jax.random.fold_in(jax.random.key(seed), STREAM)
    start = placement.split(
        _starter(env, expert), devices, (placement.SHARED, placement.LANE), placement.LANE
    )
    advance = placement.split(
        _advancer(env, expert),
        devices,
        (placement.LANE, placement.SHARED),
        placement.LANE,
        donate=(0,),
    )

    def simulate(group: list[tuple[int, int]]) -> Generator[list[episodes.Episode]]:
        count = len(group)
        index, trial = np.array(group + [group[0]] * (chunk - count), np.int32).T
        trials = _Trials(Trocar(*(field[index] for field in trocars)), index, trial)
        carry = start(key, trials)
        carry = carry._replace(wanted=carry.wanted & (np.arange(chunk) < count))
        running = list(range(count))
        pictures = {lane: [] for lane in running}
        others = []
        # In a thread: on a GPU a call may hold its caller while its loops ask the host whether to
        # go on.
        with ThreadPoolExecutor(1) as device:
            ahead = device.submit(advance, carry, np.int32(min(SEGMENT, max_steps)))
            for left in range(max_steps - SEGMENT, -SEGMENT, -SEGMENT):
                carry, records, status = ahead.result()
                slices = episodes.slices(records.pop("image", None), running)
                if left > 0:
                    # Before anything is waited for. If all are over, it ends at once, unused.
                    ahead = device.submit(advance, carry, np.int32(min(SEGMENT, left)))
                status = jax.device_get(status)
                others.append(jax.device_get(records))
                for lane, fetched in zip(running, episodes.fetch(slices)):
                    pictures[lane].append(fetched)
                over = [lane for lane in running if status["over"][lane] or left <= 0]
                running = [lane for lane in running if lane not in over]
                yield [
                    episodes.assemble(
                        lane, group[lane], trocars, seed, status, others, pictures.pop(lane)
                    )
                    for lane in over
                ]
                if not running:
                    return

    return simulate


def _starter(env: Any, expert: Any) -> Callable[..., _Carry]:
    # Imported here, as only programs need it: reading a dataset does not load the simulator.
    from starjax.sim import env as sim_env

    def start_one(key: jax.Array, trials: _Trials) -> _Carry:
        key = jax.random.fold_in(jax.random.fold_in(key, trials.index), trials.trial)
        key_env, key_expert = jax.random.split(key)
        state = env.reset(key_env, sim_env.EnvParams(trials.trocar))
        return _Carry(
            env=state,
            expert=expert.init(key_expert, state),
            length=jnp.zeros((), jnp.int32),
            wanted=jnp.ones((), bool),
        )

    return jax.vmap(start_one, in_axes=(None, 0))


def _advancer(env: Any, expert: Any) -> Callable[..., Any]:
    def step_one(carry: _Carry) -> tuple[_Carry, dict[str, jax.Array]]:
        command, expert_state = expert.act(carry.expert, carry.env)
        after = env.step(carry.env, command)
        # An expert that disturbs itself has the undisturbed command in its state: the one to learn.
        wanted = getattr(expert_state, "label", command)
        record = _record(env.observe(carry.env), wanted, carry.env, after)
        length = carry.length + ~carry.env.done
        return _Carry(after, expert_state, length, carry.wanted), record

    step = jax.vmap(step_one)

    def advance(carry: _Carry, steps: jax.Array) -> tuple[_Carry, dict[str, Any], dict[str, Any]]:
        """Up to `steps` control steps, fewer when all episodes are over.

        Returns the carry, records `[N, SEGMENT]`, and the status `[N]`.
        """
        shapes = jax.eval_shape(step, carry)[1]
        blank = jax.tree.map(
            lambda s: jnp.zeros((s.shape[0], SEGMENT, *s.shape[1:]), s.dtype), shapes
        )

        def is_running(loop):
            t, carry, _ = loop
            return (t < steps) & jnp.any(carry.wanted & ~carry.env.done)

        def body(loop):
            t, carry, records = loop
            carry, record = step(carry)
            # In place: not `.at[:, t].set`, a scatter, which may move the whole of the pictures.
            put = functools.partial(jax.lax.dynamic_update_index_in_dim, index=t, axis=1)
            return t + 1, carry, jax.tree.map(put, records, record)

        _, carry, records = jax.lax.while_loop(is_running, body, (jnp.int32(0), carry, blank))
        return carry, records, _status(carry)

    return advance


def _record(observation: Observation, command: Command, before: Any, after: Any) -> dict[str, Any]:
    frame = {
        "p": observation.pose.p,
        "R": observation.pose.R,
        "gripper": observation.gripper,
        "image": observation.image,
        "state": observation.state,
        "command_p": command.pose.p,
        "command_R": command.pose.R,
        "command_gripper": command.gripper,
        "qpos": before.sim.qpos,
        "rcm_error": after.rcm_error,
    }
    return {name: leaf for name, leaf in frame.items() if leaf is not None}


def frame(env: Any) -> dict[str, jax.ShapeDtypeStruct]:
    """Shapes of one recorded frame, without computing anything."""
    from starjax.sim import env as sim_env

    def one(key):
        state = env.reset(key, sim_env.EnvParams(Trocar(*jnp.zeros(3))))
        observation = env.observe(state)
        return _record(observation, Command(observation.pose, observation.gripper), state, state)

    return jax.eval_shape(one, jax.random.key(0))


def _status(carry: _Carry) -> dict[str, jax.Array]:
    state = carry.env
    status = {
        "over": state.done,
        "length": carry.length,
        "success": state.success & ~state.invalid,
        "loose": state.loose,
        "invalid": state.invalid,
        "collided": state.collided,
    }
    # Copied, as the next segment is given the carry's memory before the host has read this.
    return jax.tree.map(jnp.copy, status)
