"""Connections to a server for programs that wait for its answers."""

import queue
from typing import Any

from websockets.sync import client as sockets

from starjax.core.errors import UsageError
from starjax.deploy import connection, wire

TIMEOUT_S = 120.0  # for an answer: a server may compile at the first request
CONNECT_S = 10.0


class LostServer(UsageError):
    """A server that does not answer, or does not answer in its protocol."""


class ConnectionPool:
    """Connections that threads take in turn, one request at a time on each.

    Attributes:
      address: `ws://HOST:PORT`.
      metadata: the server's greeting.
    """

    def __init__(self, address: str, api_key: str = "", timeout_s: float = TIMEOUT_S) -> None:
        """Connects once.

        Raises:
          UsageError: no server answers, or it refuses the key.
        """
        self.address, self._api_key, self._timeout_s = address, api_key, timeout_s
        self._sockets: queue.SimpleQueue[sockets.ClientConnection] = queue.SimpleQueue()
        self.metadata = self._open()

    def widen(self, count: int) -> None:
        """Connects until there are `count` connections, all to the same policy."""
        for _ in range(count - self._sockets.qsize()):
            if (other := self._open()).get("digest") != (own := self.metadata.get("digest")):
                raise UsageError("address", f"policy {own} at every connection", repr(other)[:80])

    def ask(self, request: dict[str, Any]) -> Any:
        """Returns the answer to a request: a value, or a text that describes an error.

        Raises:
          LostServer: the connection breaks, the answer is late or cannot be read.
        """
        frame = wire.pack(request)
        socket = self._sockets.get()
        try:
            socket.send(frame)
            reply = socket.recv(self._timeout_s)
        except TimeoutError:
            raise self._lost(f"none within {self._timeout_s:g} s") from None
        except connection.FAULTS as error:
            raise self._lost(str(error) or type(error).__name__) from None
        finally:
            self._sockets.put(socket)
        try:
            return reply if isinstance(reply, str) else wire.unpack(reply)
        except UsageError as error:
            raise self._lost(str(error)) from None

    def close(self) -> None:
        """Ends the connections; none may be in use."""
        while not self._sockets.empty():
            self._sockets.get().close()

    def _lost(self, got: str) -> LostServer:
        return LostServer(self.address, "an answer", got, "rerun the same command to resume")

    def _open(self) -> dict[str, Any]:
        """Adds a connection; returns its greeting."""
        try:
            # openpi's server answers no ping while its policy computes
            socket = connection.connect(self.address, self._api_key, CONNECT_S, 1.0, ping_s=None)
            metadata = wire.unpack(socket.recv(self._timeout_s))
        except connection.FAULTS as error:
            got = str(error) or type(error).__name__
            raise UsageError("--policy", f"a server at {self.address}", got) from None
        if not isinstance(metadata, dict):
            raise UsageError("greeting", "a map", type(metadata).__name__)
        self._sockets.put(socket)
        return metadata
