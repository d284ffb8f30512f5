"""Simulated robots that a server drives over a simulated bad network.

A simulated clock counts control steps and stands still while a due reply is awaited: the load of
this machine has no effect. Frames use real sockets to a real server. Delays, jitter and drops are
in simulated time, from a request to its reply, inference included.
"""

import dataclasses
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from starjax import deploy, rcm
from starjax.core.types import Command, Pose
from starjax.deploy.connection import Connection, Reply
from starjax.sim import env as envs
from starjax.sim.rollouts import episodes

_SETTLED_S = 120.0  # for a server to start


@dataclasses.dataclass(frozen=True)
class Network:
    """Faults of a network, in s of the simulated clock.

    Attributes:
      delay_s: of every reply.
      jitter_s: mean of an exponential distribution of additional delay.
      drop: fraction of replies that never arrive.
      timeout_s: of a reply.
      kills_s: times at which the server is killed (SIGKILL) and restarted.
      ahead: as of `deploy.Client`.
    """

    delay_s: float = 0.0
    jitter_s: float = 0.0
    drop: float = 0.0
    timeout_s: float = 1.0
    kills_s: tuple[float, ...] = ()
    ahead: int | None = None


class Clock:
    """Seconds of the simulation."""

    def __init__(self) -> None:
        self.now = 0.0


class Server:
    """`starjax serve` in a process of its own."""

    def __init__(self, policy: str, batch: int) -> None:
        self._flags = ["--policy", policy, "--batch", str(batch)]
        self.address, self._process = "", None
        self.start()

    def start(self) -> None:
        """Starts it at its previous port, if any, and then returns at once."""
        port = self.address.rpartition(":")[2] or "0"
        command = [sys.executable, "-m", "starjax", "serve", *self._flags, "--port", port]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        while not self.address:
            line = self._process.stdout.readline()
            found = re.search(r"ws://\S+:\d+", line)
            self.address = found[0] if found else ""
            if not line:
                raise RuntimeError("the server has not started")

    def kill(self) -> None:
        """Kills it, as a loss of power would."""
        self._process.send_signal(signal.SIGKILL)
        self._process.wait()


class BadConnection(Connection):
    """A connection whose replies arrive by the simulated clock, or never."""

    def __init__(self, clock: Clock, network: Network, rng: np.random.Generator, *given: Any):
        self._clock, self._network, self._rng = clock, network, rng
        self._due, self._is_dropped = None, False
        address, api_key, _, _ = given
        super().__init__(address, api_key, _SETTLED_S, _SETTLED_S)

    def send(self, value: dict[str, Any]) -> None:
        network, rng = self._network, self._rng
        self._is_dropped = rng.random() < network.drop
        late = rng.exponential(network.jitter_s) if network.jitter_s else 0.0
        wait = network.timeout_s if self._is_dropped else network.delay_s + late
        self._due = self._clock.now + wait
        super().send(value)

    def poll(self) -> Reply | None:
        if self._due is None or self._clock.now < self._due - 1e-6:
            return None
        reply = self.wait(_SETTLED_S)
        self._due = None
        return Reply(None, "dropped", is_lost=True) if self._is_dropped else reply


class Driven:
    """Results of trials with one network: episodes, reports of the clients, their largest steps.

    Attributes:
      move, turn: m and rad, the largest between two commands.
      outages: control steps that passed from each kill until the server answered again.
    """

    def __init__(self) -> None:
        self.episodes: list[episodes.Episode] = []
        self.reports: list[deploy.Report] = []
        self.reconnected = 0
        self.move = self.turn = 0.0
        self.outages: list[int] = []


def programs(image_size: int) -> tuple[envs.Env, Callable, Callable, Callable]:
    """Makes the environment, and its reset, step and observe of a batch."""
    made = envs.make(image_size=image_size)
    reset = jax.jit(jax.vmap(lambda key, trocar: made.reset(key, envs.EnvParams(trocar))))
    step, observe = (jax.jit(jax.vmap(f)) for f in (made.step, made.observe))
    return made, reset, step, observe


def drive(
    simulation: tuple[envs.Env, Callable, Callable, Callable],
    server: Server,
    network: Network,
    group: Sequence[episodes.Trial],
    seed: int,
    most_s: float,
    driven: Driven,
) -> None:
    """Runs the trials `group` together, each with a client of its own; adds to `driven`.

    Starts and random keys are those of `starjax evaluate` with the same seed.
    """
    made, reset, step, observe = simulation
    trocars, key = made.task.trocars, jax.random.key(seed)
    keys = [jax.random.fold_in(jax.random.fold_in(key, c), n) for c, n in group]
    keys = [jax.random.split(key) for key in keys]
    ports = rcm.Trocar(*(field[[c for c, _ in group]] for field in trocars))
    state, clock = reset(jax.numpy.stack([k[0] for k in keys]), ports), Clock()
    clients = []
    for i, (_, key_agent) in enumerate(keys):
        port = rcm.Trocar(*(float(field[i, 0]) for field in ports))
        rng = np.random.default_rng([seed, *group[i]])

        def connect(*given: Any, rng: np.random.Generator = rng) -> BadConnection:
            return BadConnection(clock, network, rng, *given)

        # The network is tested: a monitor would stop some robots.
        given = {"key": key_agent, "ahead": network.ahead, "connect": connect, "is_watched": False}
        clients.append(deploy.Client(server.address, port, **given))
    records, kills = [], list(network.kills_s)
    down: int | None = None
    try:
        for t in range(round(most_s * made.control_hz)):
            if kills and clock.now >= kills[0]:
                server.kill()
                server.start()
                kills, down = kills[1:], t
            seen, done = jax.device_get((observe(state), state.done))
            killed = len(network.kills_s) - len(kills)
            back = [client.reconnected >= killed for client, over in zip(clients, done) if not over]
            if down is not None and all(back):
                driven.outages.append(t - down)
                down = None
            commands = [
                client.step(_moment(seen, i)) if not done[i] else records[-1][0][i]
                for i, client in enumerate(clients)
            ]
            before, state = state, step(state, _stacked(commands))
            records.append((commands, _of_step(before, state)))
            clock.now += 1.0 / made.control_hz
            if bool(np.all(state.done)):
                break
        for i, client in enumerate(clients):
            driven.reports.append(client.report)
            driven.reconnected += client.reconnected
            driven.episodes.append(_episode(made, state, records, i, group[i], ports, seed))
            _steps(driven, [step[0][i] for step in records])
    finally:
        for client in clients:
            client.close()


def _moment(seen: Any, i: int) -> deploy.Observation:
    """Returns the measurements of one-armed robot i."""
    R, p, gripper = seen.pose.R[i, 0], seen.pose.p[i, 0], seen.gripper[i, 0]
    return deploy.Observation(Pose(R, p), gripper, image=seen.images["camera"][i])


def _stacked(commands: list[Command]) -> Command:
    return jax.tree.map(lambda *x: np.stack(x)[:, None], *commands)


def _of_step(before: Any, after: Any) -> dict[str, np.ndarray]:
    return jax.device_get(
        {
            "was_done": before.done,
            "rcm_error": after.rcm_error,
            "rcm_error_within": after.rcm_error_within,
        }
    )


def _steps(driven: Driven, commands: list[Command]) -> None:
    R, p = (np.stack([x.pose[n] for x in commands]).astype(np.float64) for n in (0, 1))
    if len(p) < 2:
        return
    cos = (np.einsum("tij,tij->t", R[1:], R[:-1]) - 1.0) / 2.0
    driven.move = max(driven.move, float(np.linalg.norm(np.diff(p, axis=0), axis=-1).max()))
    driven.turn = max(driven.turn, float(np.arccos(np.clip(cos, -1.0, 1.0)).max()))


def _episode(
    made: envs.Env,
    state: Any,
    records: list[tuple[list[Command], dict[str, np.ndarray]]],
    i: int,
    trial: episodes.Trial,
    ports: rcm.Trocar,
    seed: int,
) -> episodes.Episode:
    """Builds the episode as an evaluation records it."""
    taken = [n for n, (_, record) in enumerate(records) if not record["was_done"][i]]
    where = np.asarray(rcm.trocar_position(ports, made.p_world_ref), np.float64)[i, 0]
    poses = [records[n][0][i].pose for n in taken]
    R, p = (np.stack([pose[n] for pose in poses]).astype(np.float64) for n in (0, 1))
    off = np.linalg.norm(np.cross(p - where, R[:, :, 2]), axis=-1)
    labels = jax.tree.map(lambda x: x[i], jax.vmap(made.labels)(state))
    outcome = {
        "trocar": trial[0],
        **{name: field[i].tolist() for name, field in ports._asdict().items()},
        "trial": trial[1],
        "seed": seed,
        "length": len(taken),
        **{name: bool(getattr(state, name)[i]) for name in episodes.FLAGS},
        "stage": int(state.stage[i]),
        "labels": {name: int(label) for name, label in labels.items()},
    }
    arrays = {
        name: [np.stack([records[n][1][name][i] for n in taken])]
        for name in ("rcm_error", "rcm_error_within")
    }
    return episodes.Episode(outcome, {**arrays, "rcm_error_commanded": [off[:, None]]})
