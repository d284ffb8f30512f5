"""Collects demonstrations: the expert in every trocar, as one program over (trocar, trial).

What ends up on disk is a function of the description and the seed alone. Trials are drawn in waves:
`per_trocar` at each trocar, then as many as failed, until every trocar has its successes; so the
first successes by trial number are kept, whatever the chunk. A wave's chunks are the same in every
run, and a chunk with a missing episode is simulated again as a whole: after any interruption the
same command ends in the same bytes.
"""

import concurrent.futures
import hashlib
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from starjax.data import lanes, store
from starjax.rcm.trocar import Trocar
from starjax.runtime import files, progress, xla
from starjax.sim.types import Observation
from starjax.types import Command

SEGMENT = 64  # control steps between two looks at the host: bounds the memory of recorded pictures
MIN_SUCCESS_RATE = 0.5  # below it at some trocar, the expert is broken and collecting stops
# Demonstrations never start from the states that an evaluation with the same seed draws.
_STREAM = 0x64656D6F
COMMITS = 8  # episodes written at once
FRAME_GUESS = 300  # control steps of a typical demonstration, for the estimate of disk space

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


def describe(
    env: Any,
    trocars: Trocar,
    *,
    per_trocar: int,
    seed: int,
    max_steps: int,
    keep_failures: bool = False,
) -> dict[str, Any]:
    """What a dataset is: the content of dataset.json, and by `store.digest` its name."""
    frame = _frame(env)
    features = {
        name: {"shape": list(leaf.shape), "dtype": np.dtype(leaf.dtype).str, "what": FIELDS[name]}
        for name, leaf in frame.items()
    }
    return {
        "seed": seed,
        "per_trocar": per_trocar,
        "max_steps": max_steps,
        "keep_failures": keep_failures,
        "trocars": np.stack([np.asarray(f, np.float64) for f in trocars], -1).tolist(),
        "p_world_ref": np.asarray(env.p_world_ref, np.float64).tolist(),
        "control_hz": env.control_hz,
        "features": features,
        "scene": _scene_hash(env.model),
        "seed_rule": f"fold_in(fold_in(fold_in(key(seed), {_STREAM}), trocar), trial)",
        "versions": xla.versions(),
    }


def collect(
    root: Path,
    env: Any,
    expert: Any,
    trocars: Trocar,
    *,
    per_trocar: int,
    seed: int,
    max_steps: int,
    keep_failures: bool = False,
    chunk: int = 0,
    devices: Sequence[jax.Device] | None = None,
    report: Callable[[str], None] = print,
) -> dict[str, Any]:
    """Collects what is missing of a dataset, and seals it.

    Args:
      root: folder of the dataset.
      env: `sim.env.Env`; its observation decides whether pictures or task states are stored.
      expert: has the functions of `Expert`.
      trocars: fields `[C]`.
      per_trocar: successful episodes wanted at each.
      max_steps: control steps after which an episode has failed.
      keep_failures: store failed episodes too.
      chunk: episodes simulated at once; 0 for what suits the machine.
      devices: to split a chunk over.
      report: gets lines for the user.

    Returns:
      {"digest", "episodes", "trials", "frames"}: the dataset's hash, successes kept, trials drawn
      for them, frames stored.

    Raises:
      StorageError: the folder cannot be written, is in use, holds another dataset, or is too small.
      ValueError: an argument out of range, or an expert that fails too often.
    """
    if per_trocar < 1 or max_steps < 1 or chunk < 0:
        got = {"per_trocar": per_trocar, "max_steps": max_steps, "chunk": chunk}
        raise ValueError(f"per_trocar, max_steps: expected 1 or more, chunk: 0 or more, got {got}")
    trocars = Trocar(*(np.asarray(field, np.float32) for field in trocars))
    frame_bytes = sum(math.prod(x.shape) * x.dtype.itemsize for x in _frame(env).values())
    total = per_trocar * len(trocars.radius)

    with files.lock(root):
        description = describe(
            env,
            trocars,
            per_trocar=per_trocar,
            seed=seed,
            max_steps=max_steps,
            keep_failures=keep_failures,
        )
        store.create(root, description)
        store.clean(root)
        records = _sound(root, report)
        done = sum(r["success"] for r in records.values())
        files.require_writable(
            root, max(total - done, 0) * min(max_steps, FRAME_GUESS) * frame_bytes
        )
        chunk = chunk or _chunk(total, frame_bytes, devices)
        chunk = -(-chunk // len(devices or [0])) * len(devices or [0])
        simulate = _simulator(env, expert, trocars, seed, max_steps, chunk, devices)
        shown = progress.track("Demonstrations", total, unit="episodes", done=done)
        with shown as advance, concurrent.futures.ThreadPoolExecutor(COMMITS) as pool:
            drawn = np.zeros(len(trocars.radius), int)
            while wave := _wave(records, drawn, per_trocar, seed):
                for group in (wave[i : i + chunk] for i in range(0, len(wave), chunk)):
                    missing = [i for i, t in enumerate(group) if store.key(*t, seed) not in records]
                    if not missing:
                        continue
                    episode = simulate(group)

                    def commit(lane: int, episode=episode) -> store.Record:
                        outcome, arrays = episode(lane)
                        key = store.key(outcome["trocar"], outcome["trial"], seed)
                        kept = outcome["success"] or keep_failures
                        return store.commit(root, key, outcome, arrays if kept else {})

                    # In threads: most of a commit is waiting for the disk.
                    for record in pool.map(commit, missing):
                        records[record["key"]] = record
                        advance(int(record["success"]))
        digest = store.seal(root, records)
    return {
        "digest": digest,
        "episodes": sum(record["success"] for record in records.values()),
        "trials": len(records),
        "frames": sum(record["length"] for record in records.values() if record["files"]),
    }


def _sound(root: Path, report: Callable[[str], None]) -> dict[str, store.Record]:
    """Records of the episodes on disk; damaged ones are removed, to be collected again."""
    records = {}
    for key, found in store.verify_all(root, store.keys(root)).items():
        if isinstance(found, store.DamagedEpisode):
            report(f"damaged, collected again: {found}")
            (root / "SEALED.json").unlink(missing_ok=True)
            store.remove(root, key)
        else:
            records[key] = found
    return records


def _wave(
    records: dict[str, store.Record], drawn: np.ndarray, per_trocar: int, seed: int
) -> list[tuple[int, int]]:
    """Next trials (trocar, trial): as many at each trocar as successes are missing there.

    Updates `drawn` `[C]`, the trials drawn so far at each trocar.
    """
    wave = []
    for trocar, first in enumerate(drawn.tolist()):
        done = [records[store.key(trocar, trial, seed)]["success"] for trial in range(first)]
        missing = per_trocar - sum(done)
        if missing and first >= 8 + per_trocar / MIN_SUCCESS_RATE:
            raise ValueError(
                f"expert: expected a success rate above {MIN_SUCCESS_RATE:.0%}, "
                f"got {sum(done)} of {first} at trocar {trocar}"
            )
        wave += [(trocar, first + i) for i in range(missing)]
        drawn[trocar] += missing
    return wave


def _simulator(
    env: Any,
    expert: Any,
    trocars: Trocar,
    seed: int,
    max_steps: int,
    chunk: int,
    devices: Sequence[jax.Device] | None,
) -> Callable[..., Any]:
    """The compiled programs as `group -> (lane -> (outcome, arrays))`."""
    key = jax.random.fold_in(jax.random.key(seed), _STREAM)
    start = lanes.split(_starter(env, expert), devices, (lanes.SHARED, lanes.LANE), lanes.LANE)
    advance = lanes.split(
        _advancer(env, expert),
        devices,
        (lanes.LANE, lanes.SHARED),
        (lanes.LANE, lanes.TIME_LANE),
        donate=(0,),
    )

    def simulate(group: list[tuple[int, int]]) -> Callable[[int], Any]:
        count = len(group)
        index, trial = np.array(group + [group[0]] * (chunk - count), np.int32).T
        trials = _Trials(Trocar(*(field[index] for field in trocars)), index, trial)
        carry = start(key, trials)
        carry = carry._replace(wanted=carry.wanted & (np.arange(chunk) < count))
        segments = []
        for first in range(0, max_steps, SEGMENT):
            steps = min(SEGMENT, max_steps - first)
            carry, segment = advance(carry, np.int32(steps))
            segments.append(jax.tree.map(np.asarray, segment))
            if np.all(np.asarray(carry.env.done) | ~np.asarray(carry.wanted)):
                break
        final = jax.device_get((carry.length, _outcome(carry.env)))
        return lambda lane: _episode(lane, group[lane], trocars, seed, segments, final)

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


def _advancer(env: Any, expert: Any) -> Callable[..., tuple[_Carry, dict[str, jax.Array]]]:
    def step_one(carry: _Carry) -> tuple[_Carry, dict[str, jax.Array]]:
        command, expert_state = expert.act(carry.expert, carry.env)
        after = env.step(carry.env, command)
        # An expert that disturbs itself has the undisturbed command in its state: the one to learn.
        wanted = getattr(expert_state, "label", command)
        record = _record(env.observe(carry.env), wanted, carry.env, after)
        length = carry.length + ~carry.env.done
        return _Carry(after, expert_state, length, carry.wanted), record

    step = jax.vmap(step_one)

    def advance(carry: _Carry, steps: jax.Array) -> tuple[_Carry, dict[str, jax.Array]]:
        """Up to `steps` control steps, fewer when all episodes are over; records `[SEGMENT, N]`."""
        shapes = jax.eval_shape(step, carry)[1]
        blank = jax.tree.map(lambda s: jnp.zeros((SEGMENT, *s.shape), s.dtype), shapes)

        def is_running(loop):
            t, carry, _ = loop
            return (t < steps) & jnp.any(carry.wanted & ~carry.env.done)

        def body(loop):
            t, carry, records = loop
            carry, record = step(carry)
            records = jax.tree.map(lambda all_, one: all_.at[t].set(one), records, record)
            return t + 1, carry, records

        _, carry, records = jax.lax.while_loop(is_running, body, (jnp.int32(0), carry, blank))
        return carry, records

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


def _frame(env: Any) -> dict[str, jax.ShapeDtypeStruct]:
    """Shapes of one recorded frame, without computing anything."""
    from starjax.sim import env as sim_env

    def one(key):
        state = env.reset(key, sim_env.EnvParams(Trocar(*jnp.zeros(3))))
        observation = env.observe(state)
        return _record(observation, Command(observation.pose, observation.gripper), state, state)

    return jax.eval_shape(one, jax.random.key(0))


def _outcome(state: Any) -> dict[str, jax.Array]:
    return {
        "success": state.success & ~state.invalid,
        "loose": state.loose,
        "invalid": state.invalid,
        "collided": state.collided,
    }


def _episode(
    lane: int,
    trial: tuple[int, int],
    trocars: Trocar,
    seed: int,
    segments: list[dict[str, np.ndarray]],
    final: tuple[np.ndarray, dict[str, np.ndarray]],
) -> tuple[store.Record, dict[str, np.ndarray]]:
    lengths, outcomes = final
    length = int(lengths[lane])
    outcome = {
        "trocar": trial[0],
        "radius": float(trocars.radius[trial[0]]),
        "polar": float(trocars.polar[trial[0]]),
        "azimuth": float(trocars.azimuth[trial[0]]),
        "trial": trial[1],
        "seed": seed,
        "length": length,
        **{name: bool(value[lane]) for name, value in outcomes.items()},
    }
    arrays = {
        name: np.concatenate([segment[name][:, lane] for segment in segments])[:length]
        for name in segments[0]
    }
    return outcome, arrays


def _chunk(total: int, frame_bytes: int, devices: Sequence[jax.Device] | None) -> int:
    """Episodes at once: 16 fill a CPU, a GPU takes hundreds; pictures of all must fit the host."""
    fast = 16 if jax.default_backend() == "cpu" else 256 * len(devices or [0])
    fits = int(0.25 * xla.memory_bytes() // (2 * FRAME_GUESS * frame_bytes))
    return max(1, min(fast, fits, total))


def _scene_hash(model: Any) -> str:
    """Identifies the simulated scene; empty where the environment has no MuJoCo model."""
    mj_model = getattr(model, "mj_model", None)
    if mj_model is None:
        return ""
    import mujoco

    buffer = np.zeros(mujoco.mj_sizeModel(mj_model), np.uint8)
    mujoco.mj_saveModel(mj_model, None, buffer)
    return hashlib.sha256(buffer.tobytes()).hexdigest()
