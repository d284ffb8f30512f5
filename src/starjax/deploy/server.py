"""Serves a policy over websockets, in openpi's protocol, to several clients at once.

The event loop reads frames and one thread runs the policy. Requests that arrive during an inference
share the next one, so clients do not wait in line. An invalid frame gets a line of text as its
reply and ends neither the connection nor the server.
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
from starjax.core.errors import UsageError
from starjax.deploy import batching, client_log, requests, wire
from starjax.deploy.policy import Deployed
from starjax.policies.monitor import record
from starjax.runtime import connections
from starjax.sim.task import CONTROL_HZ

_POLL_S = 0.1  # between two calls of `should_stop`
_MAX_ERROR = 2000  # characters
_MAX_QUEUE = 2  # unread frames of a connection
_SILENT = logging.getLogger("starjax.serve")  # failed handshakes, as of port scanners
_SILENT.addHandler(logging.NullHandler())
_SILENT.propagate = False


class ServerSettings(NamedTuple):
    """Settings of a server.

    Attributes:
      host: address to listen at; 0.0.0.0 is every network of this machine.
      port: 0 is any free one.
      batch: maximum robots per inference.
      clients: maximum connections at once, unfinished handshakes included.
    """

    host: str = "127.0.0.1"
    port: int = 8000
    batch: int = 4
    clients: int = 32


@dataclasses.dataclass
class Counts:
    """Counts of a server's work.

    Attributes:
      clients: connections so far.
      answered: requests answered by a plan.
      refused: frames answered by an error.
      calls: inferences.
    """

    clients: int = 0
    answered: int = 0
    refused: int = 0
    calls: int = 0


class _Job(NamedTuple):
    request: wire.Request
    reply: asyncio.Future


def run(
    policy: Deployed,
    settings: ServerSettings,
    *,
    name: str = "",
    api_key: str = "",
    should_stop: Callable[[], bool] = lambda: False,
    listening: Callable[[str, int], Any] = lambda host, port: None,
    log: Callable[[str], Any] = lambda line: None,
    address: socket.socket | None = None,
) -> Counts:
    """Compiles the programs, then serves until `should_stop()`.

    Args:
      policy: the served policy.
      name: of the policy, for the greeting.
      api_key: required of clients; empty for none.
      listening: called with address and port as soon as clients can connect.
      log: called with a line about a client: its coming, refused requests, its leaving.
      address: bound socket, by default one of the settings' address.

    Raises:
      UsageError: the address is not available.
    """
    with address or connections.bind(settings.host, settings.port) as address:
        batches = batching.Batches(policy, settings.batch)
        batches.warm_up()
        greeting = metadata(policy, name, settings.batch)
        server = _Server(batches, settings, greeting, api_key, log)
        asyncio.run(server.serve(address, should_stop, listening))
    return server.counts


def metadata(policy: Deployed, name: str = "", batch: int = 1) -> dict[str, Any]:
    """Describes the policy: the greeting of a connecting client."""
    settings, spec = policy.settings, policy.input_spec
    arrays = wire.request_arrays(spec).items()
    return {
        "protocol": wire.PROTOCOL,
        "starjax": starjax.__version__,
        "policy": name,
        "digest": policy.digest,
        "method": policy.method,
        "scene": _plain(policy.scene),
        "control_hz": CONTROL_HZ,
        "horizon": settings.horizon,
        "execute": settings.execute,
        "batch": batch,
        "asks": {name: value for name, value in _plain(spec).items() if name != "wrist" or value},
        "inputs": {field: _plain(row) for field, row in arrays},
        "actions": list(wire.ACTION),
        **({"monitor": record.to_json(policy.monitor)} if policy.monitor else {}),
    }


def _plain(record: NamedTuple) -> dict[str, Any]:
    """Returns the fields of a NamedTuple, tuples as lists."""
    return {k: list(v) if isinstance(v, tuple) else v for k, v in record._asdict().items()}


def _place(connection: sockets.ServerConnection) -> str:
    """Returns the address of a client."""
    return ":".join(map(str, (connection.remote_address or ("unknown",))[:2]))


class _Server:
    def __init__(
        self,
        batches: batching.Batches,
        settings: ServerSettings,
        greeting: dict[str, Any],
        api_key: str,
        log: Callable[[str], Any] = lambda line: None,
    ) -> None:
        self.log = log
        self.batches, self.settings, self.counts = batches, settings, Counts()
        self.greeting, self.api_key = wire.pack(greeting), api_key
        self.jobs: asyncio.Queue[_Job] = asyncio.Queue()

    async def serve(
        self,
        address: socket.socket,
        should_stop: Callable[[], bool],
        listening: Callable[..., Any],
    ) -> None:
        serving = sockets.serve(
            self._connected,
            sock=address,
            process_request=self._admit,
            # Browsers send an origin: a web page must not reach this machine's ports.
            origins=[None],
            create_connection=connections.limited(self.settings.clients),
            open_timeout=connections.HANDSHAKE_S,
            compression=None,
            max_size=wire.max_request_bytes(self.batches.policy.input_spec),
            max_queue=_MAX_QUEUE,
            logger=_SILENT,
        )
        try:
            server = await serving
        except OSError as error:  # as when another server took the port during the compilation
            place = ":".join(map(str, address.getsockname()[:2]))
            raise UsageError("--port", "a free address", place, str(error)) from None
        # The server leaves first: closing its connections waits for their pending replies.
        async with self._inference() as inference, server:
            listening(*server.sockets[0].getsockname()[:2])
            while not (should_stop() or inference.done()):
                await asyncio.wait([inference], timeout=_POLL_S)

    @contextlib.asynccontextmanager
    async def _inference(self) -> AsyncIterator[asyncio.Task]:
        with ThreadPoolExecutor(1, "starjax-inference") as thread:
            task = asyncio.create_task(self._infer(thread))
            yield task
            task.cancel()
            await asyncio.wait([task])

    async def _infer(self, thread: ThreadPoolExecutor) -> None:
        loop = asyncio.get_running_loop()
        while True:
            jobs = [await self.jobs.get()]
            while len(jobs) < self.batches.max_robots and not self.jobs.empty():
                jobs.append(self.jobs.get_nowait())
            requests = [job.request for job in jobs]
            try:
                replies = await loop.run_in_executor(thread, self.batches.infer, requests)
            except Exception as error:  # as of the device: clients receive it, the server continues
                fault = UsageError("policy", "a plan", f"{type(error).__name__}: {error}")
                replies = [fault] * len(jobs)
            self.counts.calls += 1
            for job, reply in zip(jobs, replies, strict=True):
                if not job.reply.done():
                    job.reply.set_result(reply)

    async def _connected(self, connection: sockets.ServerConnection) -> None:
        self.counts.clients += 1
        name = f"client {self.counts.clients} ({_place(connection)})"
        log = client_log.ClientLog(self.log, name)
        history = requests.History(self.batches.policy.input_spec)
        try:
            await connection.send(self.greeting)
            async for frame in connection:
                await connection.send(await self._answer(frame, history, log))
        except websockets.ConnectionClosed:
            pass
        finally:
            log.leave(connection.close_reason or "")

    async def _answer(
        self, frame: str | bytes, history: requests.History, log: client_log.ClientLog
    ) -> str | bytes:
        spec, key_size = self.batches.policy.input_spec, self.batches.key_size
        try:
            value, moment = history.complete(wire.unpack(frame))
            request = wire.decode_request(spec, value, key_size)
            job = _Job(request, asyncio.get_running_loop().create_future())
            self.jobs.put_nowait(job)
            reply = await job.reply
            if isinstance(reply, UsageError):
                raise reply
        except UsageError as error:
            self.counts.refused += 1
            log.refuse(str(error))
            return str(error)[:_MAX_ERROR]
        history.keep(moment)
        self.counts.answered += 1
        log.answered += 1
        return wire.pack(reply)

    def _admit(self, connection: sockets.ServerConnection, request: websockets.Request) -> Any:
        """Returns None for a client that may connect, else the response that refuses it."""
        if request.path == "/healthz":
            return connection.respond(http.HTTPStatus.OK, "OK\n")
        sent = request.headers.get_all("Authorization")
        expected = f"Api-Key {self.api_key}".encode()
        if self.api_key and not (
            len(sent) == 1 and hmac.compare_digest(sent[0].encode(errors="replace"), expected)
        ):
            self.log(f"{_place(connection)}: refused, expected the API key")
            return connection.respond(http.HTTPStatus.UNAUTHORIZED, "expected an API key\n")
        if connections.count(connection) > self.settings.clients:
            self.log(f"{_place(connection)}: refused, more than {self.settings.clients} clients")
            return connection.respond(http.HTTPStatus.SERVICE_UNAVAILABLE, "too many clients\n")
        return None
