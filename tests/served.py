"""A small policy with random weights, behind a server in a thread of the test's process."""

import contextlib
import dataclasses
import queue
import threading

import fakes
import jax
import numpy as np

from starjax import deploy, rcm
from starjax.core.methods import METHODS
from starjax.data import normalizer
from starjax.deploy import server, wire
from starjax.policies import policy as policies
from starjax.policies import policy_file
from starjax.runtime import connections
from starjax.sim import names

SCENE = names.SceneNames("fake", ("fr5",), ("grasper",), ("camera",))
PORT = rcm.Trocar(*(float(field[0]) for field in rcm.TROCARS))
KEY = "open sesame"


def policy(folder):
    """A file of a policy of the state, loaded; its plans may begin anywhere."""
    dataset = fakes.dataset(seed=0)
    settings = dataclasses.replace(fakes.TINY)
    made = policies.make(METHODS["stardiff"], settings, fakes.TASK)
    stats = normalizer.fit(METHODS["stardiff"], fakes.TASK, dataset, np.arange(80))
    init = jax.jit(made.init, compiler_options={"xla_backend_optimization_level": 0})
    path = folder / "policy.safetensors"
    params = init(jax.random.key(0))
    trained = fakes.trained(policy=settings, params=params, normalizer=stats, scene=SCENE)
    policy_file.save(path, trained)
    return deploy.load(path, max_first_move=np.inf, max_first_turn=np.inf)


def moment(height=0.03):
    """A tool at rest through the first trocar, a little above the board."""
    action = [0.0, 0.0, 0.0, height]
    pose, _ = rcm.ACTION_SPACES["rcm4"].decode(action, PORT, fakes.P_WORLD_REF[0])
    pose = jax.tree.map(np.asarray, pose)
    return deploy.Observation(pose=pose, gripper=np.float32(1.0), state=np.zeros(12, np.float32))


def observation(height=0.03):
    """The same for as many moments as the policy looks at."""
    return jax.tree.map(lambda x: np.stack([x, x]), moment(height))


@contextlib.contextmanager
def running(batches, port=0, key=KEY, clients=8, log=lambda line: None):
    """A server of compiled `batches`; yields (host, port), its counts."""
    settings = server.ServerSettings(port=port, batch=batches.max_robots, clients=clients)
    stop, heard = threading.Event(), queue.Queue()
    with connections.bind(settings.host, settings.port) as address:
        about = server.metadata(batches.policy, "tiny")
        one = server._Server(batches, settings, about, key, log)
        work = threading.Thread(
            target=lambda: server.asyncio.run(
                one.serve(address, stop.is_set, lambda *where: heard.put(where))
            )
        )
        work.start()
        try:
            yield heard.get(timeout=30.0), one.counts
        finally:
            stop.set()
            work.join()


def bad_frame(rng, good):
    """An invalid frame: cut, flipped, random, or another map."""
    kind = rng.integers(5)
    if kind == 0:
        return good[: rng.integers(len(good))]
    if kind == 1:
        flipped = bytearray(good)
        for at in rng.integers(len(good), size=rng.integers(1, 9)):
            flipped[at] ^= 1 << rng.integers(8)
        return bytes(flipped)
    if kind == 2:
        return rng.bytes(rng.integers(200))
    if kind == 3:
        return "text" * rng.integers(9)
    odd = [None, -1, 2.5, "x", [], {}, {b"__ndarray__": True}, np.zeros((2, 3)), 10**18, np.nan]
    value = wire.unpack(good)
    names = [*value, b"p", 7, "more"]
    value[names[rng.integers(len(names))]] = odd[rng.integers(len(odd))]
    return wire.pack(value)
