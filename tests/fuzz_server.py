"""Sends bad frames, bad bytes and broken connections to a running `starjax serve`, by the thousand.

    python tests/fuzz_server.py [FRAMES] [SEED]

Prints their outcomes. It fails if the server ends, or answers a good request otherwise after
them than before. A part of the frames, `served.bad_frame` alone, is in the tests.
"""

import collections
import re
import socket
import subprocess
import sys

import jax
import numpy as np
import served
import websockets
from websockets.sync import client as sockets

from starjax import deploy
from starjax.deploy import batching, wire

EACH = 50  # frames on a connection, at most


def main(frames, seed):
    rng, counts = np.random.default_rng(seed), collections.Counter()
    policy = deploy.load("compact")
    asked = batching.example(policy.input_spec)
    key = np.asarray(jax.random.key_data(jax.random.key(0)))
    good = wire.pack(wire.encode_request(policy.input_spec, asked.observation, asked.trocar, key))
    command = [sys.executable, "-m", "starjax", "serve", "--port", "0", "--batch", "1"]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        lines = iter(server.stdout.readline, "")
        address = next(
            found[0] for found in (re.search(r"ws://\S+:\d+", x) for x in lines) if found
        )
        before = answer(address, good)
        while counts["frames"] < frames:
            talk(address, rng, good, counts)
            stranger(address, rng, counts)
        after = answer(address, good)
    finally:
        server.terminate()
    print(", ".join(f"{count} {name}" for name, count in counts.items()))
    same = np.array_equal(before["p"], after["p"])
    print(f"the server lives, and its plan is {'the same' if same else 'ANOTHER ONE'}")
    return 0 if same else 1


def answer(address, good):
    with sockets.connect(address, compression=None) as connection:
        connection.recv()
        connection.send(good)
        return wire.unpack(connection.recv())


def talk(address, rng, good, counts):
    """Bad frames on a connection, which is left without a word now and then."""
    connection = sockets.connect(address, compression=None)
    connection.recv()
    counts["connections"] += 1
    try:
        for _ in range(rng.integers(1, EACH)):
            frame = served.bad_frame(rng, good)
            if rng.random() < 0.01:
                frame = bytes(len(good) * 4)
            connection.send(frame)
            counts["frames"] += 1
            if rng.random() < 0.02:  # gone before it is answered
                connection.socket.close()
                counts["left without a word"] += 1
                return
            said = connection.recv(timeout=60)
            counts["refused by a line" if isinstance(said, str) else "answered"] += 1
        connection.close()
    except websockets.ConnectionClosed:
        counts["connections closed by the server"] += 1


def stranger(address, rng, counts):
    """Bytes without a handshake, or half of one."""
    host, port = address.removeprefix("ws://").split(":")
    half = b"GET / HTTP/1.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    with socket.create_connection((host, int(port)), timeout=20) as raw:
        raw.sendall(half if rng.random() < 0.5 else rng.bytes(rng.integers(1, 2000)))
        counts["strangers"] += 1


if __name__ == "__main__":
    given = [int(word) for word in sys.argv[1:]]
    sys.exit(main(*[*given, *(20_000, 0)[len(given) :]]))
