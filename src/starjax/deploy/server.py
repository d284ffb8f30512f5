"""Serves a policy over websockets, in openpi's protocol, to several clients at once.

The event loop reads frames, one thread decides. What came while it decided is decided together
next, so that one client waits for nobody and many share a call. A bad frame is answered by a line
of text; the connection, and the server, go on.
"""

import asyncio
import contextlib
import dataclasses
import hmac
import http
import logging
import socket
from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import websockets
from websockets.asyncio import server as sockets

import starjax
from starjax.deploy import batching, wire
from starjax.deploy.policy import Deployed
from starjax.errors import UsageError
from starjax.sim.tasks.base import CONTROL_HZ

_ASK_S = 0.1  # between two looks whether to stop
_LONGEST_ERROR = 2000  # characters
_SILENT = logging.getLogger("starjax.serve")  # of handshakes that fail, as strangers' do
_SILENT.addHandler(logging.NullHandler())
_SILENT.propagate = False


class ServerSettings(NamedTuple):
    """How a server listens.

    Attributes:
      host: address; 0.0.0.0 is every network of this machine.
      port: 0 is any that is free.
      batch: robots that one call decides for, at most.
      clients: connections at once, at most.
    """

    host: str = "127.0.0.1"
    port: int = 8000
    batch: int = 4
    clients: int = 32


@dataclasses.dataclass
class Counts:
    """Counts of a server's work."""

    clients: int = 0  # that have connected
    answered: int = 0  # requests
    refused: int = 0  # frames that were answered by a text
    calls: int = 0  # of the policy


class _Job(NamedTuple):
    request: wire.Request
    answer: asyncio.Future


def run(
    policy: Deployed,
    settings: ServerSettings,
    *,
    name: str = "",
    api_key: str = "",
    should_stop: Callable[[], bool] = lambda: False,
    listening: Callable[[str, int], Any] = lambda host, port: None,
) -> Counts:
    """Compiles the programs, then serves until `should_stop()`.

    Args:
      policy: is served.
      name: of the policy, for the clients.
      api_key: that clients must have; empty for none.
      listening: called with address and port, once clients may connect.

    Raises:
      UsageError: the address cannot be listened at.
    """
    with _bound(settings) as address:
        batches = batching.Batches(policy, settings.batch)
        batches.warm_up()
        served = _Served(batches, settings, metadata(policy, name), api_key)
        asyncio.run(served.serve(address, should_stop, listening))
    return served.counts


def metadata(policy: Deployed, name: str = "") -> dict[str, Any]:
    """Greeting of a client that connects."""
    settings, spec = policy.settings, policy.input_spec
    described = {
        field: {**said._asdict(), "shape": list(said.shape)}
        for field, said in wire.request_arrays(spec).items()
    }
    return {
        "protocol": wire.PROTOCOL,
        "starjax": starjax.__version__,
        "policy": name,
        "digest": policy.digest,
        "method": policy.method,
        "scene": {
            k: v if isinstance(v, str) else list(v) for k, v in policy.scene._asdict().items()
        },
        "control_hz": CONTROL_HZ,
        "horizon": settings.horizon,
        "execute": settings.execute,
        "asks": {
            **{k: list(v) if isinstance(v, tuple) else v for k, v in spec._asdict().items()},
            "p_world_ref": spec.p_world_ref,
        },
        "inputs": described,
        "actions": list(wire.ACTION),  # of each arm
    }


def _bound(settings: ServerSettings) -> socket.socket:
    """A socket at the address, before anything is compiled; nobody is listened to yet."""
    host, port = settings.host, settings.port
    bound = None
    try:
        family, *kind, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        bound = socket.socket(family, *kind)
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        bound.bind(address)
    except OSError as error:
        if bound:
            bound.close()
        where = f"{host}:{port}"
        raise UsageError("--port", "an address that is free here", where, str(error)) from None
    return bound


class _Served:
    def __init__(
        self,
        batches: batching.Batches,
        settings: ServerSettings,
        about: dict[str, Any],
        api_key: str,
    ) -> None:
        self.batches, self.settings, self.counts = batches, settings, Counts()
        self.about, self.api_key = wire.pack(about), api_key
        self.jobs: asyncio.Queue[_Job] = asyncio.Queue()
        self.open = 0

    async def serve(
        self,
        address: socket.socket,
        should_stop: Callable[[], bool],
        listening: Callable[..., Any],
    ) -> None:
        server = await sockets.serve(
            self._connected,
            sock=address,
            process_request=self._admit,
            origins=[None],  # pages in a browser have one, and could reach this machine's ports
            compression=None,
            max_size=wire.max_request_bytes(self.batches.policy.input_spec),
            max_queue=2,
            logger=_SILENT,
        )
        # It decides until the last connection is closed, as that waits for its answer.
        async with self._deciding() as deciding, server:
            listening(*server.sockets[0].getsockname()[:2])
            while not (should_stop() or deciding.done()):
                await asyncio.wait([deciding], timeout=_ASK_S)

    @contextlib.asynccontextmanager
    async def _deciding(self) -> AsyncIterator[asyncio.Task]:
        with ThreadPoolExecutor(1, "starjax-decide") as thread:
            task = asyncio.create_task(self._decide(thread))
            yield task
            task.cancel()
            await asyncio.wait([task])

    async def _decide(self, thread: ThreadPoolExecutor) -> None:
        loop = asyncio.get_running_loop()
        while True:
            jobs = [await self.jobs.get()]
            while len(jobs) < self.batches.most and not self.jobs.empty():
                jobs.append(self.jobs.get_nowait())
            asked = [job.request for job in jobs]
            try:
                answers = await loop.run_in_executor(thread, self.batches.decide, asked)
            except Exception as error:  # of the device, say: the clients hear of it, and go on
                fault = UsageError("policy", "a plan", f"{type(error).__name__}: {error}")
                answers = [fault] * len(jobs)
            self.counts.calls += 1
            for job, answer in zip(jobs, answers, strict=True):
                if not job.answer.done():
                    job.answer.set_result(answer)

    async def _connected(self, connection: sockets.ServerConnection) -> None:
        self.open += 1
        self.counts.clients += 1
        try:
            await connection.send(self.about)
            async for frame in connection:
                await connection.send(await self._answer(frame))
        except websockets.ConnectionClosed:
            pass
        finally:
            self.open -= 1

    async def _answer(self, frame: str | bytes) -> str | bytes:
        spec, key_size = self.batches.policy.input_spec, self.batches.key_size
        try:
            request = wire.decode_request(spec, wire.unpack(frame), key_size)
            job = _Job(request, asyncio.get_running_loop().create_future())
            self.jobs.put_nowait(job)
            answer = await job.answer
            if isinstance(answer, UsageError):
                raise answer
        except UsageError as error:
            self.counts.refused += 1
            return str(error)[:_LONGEST_ERROR]
        self.counts.answered += 1
        return wire.pack(answer)

    def _admit(self, connection: sockets.ServerConnection, request: Any) -> Any:
        """Admits a client: None if it may connect, else the answer that refuses it."""
        if request.path == "/healthz":
            return connection.respond(http.HTTPStatus.OK, "OK\n")
        given = request.headers.get_all("Authorization")
        wanted = f"Api-Key {self.api_key}".encode()
        if self.api_key and not (
            len(given) == 1 and hmac.compare_digest(given[0].encode(errors="replace"), wanted)
        ):
            return connection.respond(http.HTTPStatus.UNAUTHORIZED, "expected an API key\n")
        if self.open >= self.settings.clients:
            return connection.respond(http.HTTPStatus.SERVICE_UNAVAILABLE, "too many clients\n")
        return None
