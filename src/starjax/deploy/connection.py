"""A robot's connection to a server, in a thread of its own, which connects again when it breaks.

Nothing here waits in the caller's thread but the first connection.
"""

import logging
import queue
import threading
from typing import Any, NamedTuple

import websockets
from websockets.sync import client as sockets

from starjax.deploy import wire
from starjax.errors import UsageError

_FIRST_WAIT_S, _LONGEST_WAIT_S = 0.05, 1.0  # between two tries to connect
_LOOK_S = 0.05  # between two looks whether an idle connection is still there
_MOST_ANSWER = 1 << 24  # bytes of a frame that a server may send
_SILENT = logging.getLogger("starjax.link")
_SILENT.addHandler(logging.NullHandler())
_SILENT.propagate = False


class Reply(NamedTuple):
    """Outcome of a request.

    Attributes:
      value: the frame's value; None where there is none.
      fault: why there is none, else empty.
      is_lost: whether it was the connection, or time, and not the server that refused it.
    """

    value: Any
    fault: str = ""
    is_lost: bool = False


class Connection:
    """A connection that is there again and again; one request at a time.

    Attributes:
      address: `ws://HOST:PORT`.
      metadata: what the server said of itself; one that says something else later is not asked.
      fault: why there is no connection now, else empty.
      connections: how often it was made.
    """

    def __init__(self, address: str, api_key: str, timeout_s: float, wait_s: float) -> None:
        """Connects.

        Raises:
          UsageError: there is no such server within `wait_s`, or it refuses the key.
        """
        self.address = address if "://" in address else f"ws://{address}"
        self.metadata: dict[str, Any] = {}
        self.fault, self.connections = "no server there", 0
        self._headers = {"Authorization": f"Api-Key {api_key}"} if api_key else {}
        self._timeout_s = timeout_s
        self._requests: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._replies: queue.SimpleQueue[Reply] = queue.SimpleQueue()
        self._up, self._closing = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._work, name="starjax-link", daemon=True)
        self._thread.start()
        if not self._up.wait(wait_s):
            self.close()
            raise UsageError("address", "a server of a policy", self.address, self.fault)

    @property
    def is_up(self) -> bool:
        """Whether a request can be sent now."""
        return self._up.is_set()

    def send(self, value: dict[str, Any]) -> None:
        """Sends a request, where none is under way."""
        self._requests.put(wire.pack(value))

    def poll(self) -> Reply | None:
        """Outcome of the request, None as long as it is not known."""
        try:
            return self._replies.get_nowait()
        except queue.Empty:
            return None

    def wait(self, seconds: float) -> Reply | None:
        """Waits at most `seconds` for what `poll` returns."""
        try:
            return self._replies.get(timeout=seconds)
        except queue.Empty:
            return None

    def close(self) -> None:
        """Ends the connection and the thread."""
        self._closing.set()
        self._requests.put(None)
        self._thread.join()

    def _work(self) -> None:
        wait_s = _FIRST_WAIT_S
        while not self._closing.is_set():
            try:
                with self._connected() as connection:
                    self._greeted(connection.recv(self._timeout_s))
                    wait_s = _FIRST_WAIT_S
                    self._talk(connection)
            # A name that cannot be one is a ValueError of the resolver.
            except (OSError, ValueError, websockets.WebSocketException) as error:
                self.fault = str(error) or type(error).__name__
            self._up.clear()
            self._closing.wait(wait_s)
            wait_s = min(2 * wait_s, _LONGEST_WAIT_S)

    def _connected(self) -> sockets.ClientConnection:
        return sockets.connect(
            self.address,
            additional_headers=self._headers,
            compression=None,
            max_size=_MOST_ANSWER,
            open_timeout=self._timeout_s,
            close_timeout=self._timeout_s,
            logger=_SILENT,
        )

    def _greeted(self, frame: Any) -> None:
        metadata = wire.unpack(frame)
        if not isinstance(metadata, dict) or metadata.get("protocol") != wire.PROTOCOL:
            raise UsageError("address", f"a server of protocol {wire.PROTOCOL}", self.address)
        if self.metadata and metadata.get("digest") != self.metadata.get("digest"):
            raise UsageError("address", "the policy that was there before", "another one")
        self.metadata, self.fault = metadata, ""
        self.connections += 1
        self._up.set()

    def _talk(self, connection: Any) -> None:
        """Answers requests until the connection breaks, which loses the one under way."""
        while (frame := self._next_request(connection)) is not None:
            try:
                connection.send(frame)
                answer = connection.recv(self._timeout_s)
            except (OSError, websockets.WebSocketException) as error:
                self._up.clear()  # before the loss is known: nobody asks a connection that is gone
                self._replies.put(Reply(None, str(error) or "no answer in time", is_lost=True))
                raise
            self._replies.put(_read(answer))

    def _next_request(self, connection: Any) -> bytes | None:
        """The next request, None at the end; raises where the connection breaks before it."""
        while True:
            try:
                return self._requests.get(timeout=_LOOK_S)
            except queue.Empty:
                if connection.protocol.state is not websockets.State.OPEN:
                    raise ConnectionError("the server has closed the connection") from None


def _read(frame: Any) -> Reply:
    if isinstance(frame, str):
        return Reply(None, frame)
    try:
        return Reply(wire.unpack(frame))
    except UsageError as error:
        return Reply(None, str(error))
