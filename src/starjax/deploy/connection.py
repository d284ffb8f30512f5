"""A robot's connection to a server: its own thread, reconnects when the connection breaks.

Only the first connection blocks the caller's thread.
"""

import logging
import queue
import threading
from typing import Any, NamedTuple

import websockets
from websockets.sync import client as sockets

from starjax.core.errors import UsageError
from starjax.deploy import wire

_FIRST_WAIT_S, _MAX_WAIT_S = 0.05, 1.0  # between two attempts to connect; doubles
_POLL_S = 0.05  # between two checks of an idle connection
MAX_REPLY = 1 << 24  # bytes of a server's frame
# The resolver raises ValueError for impossible host names.
FAULTS = (OSError, ValueError, websockets.WebSocketException)
_SILENT = logging.getLogger("starjax.connection")
_SILENT.addHandler(logging.NullHandler())
_SILENT.propagate = False


class Reply(NamedTuple):
    """Outcome of a request, or the loss of the connection.

    Attributes:
      value: the frame's value, or None without an answer.
      fault: reason of a missing value, else empty.
      is_lost: True if the connection broke or timed out, False if the server refused.
    """

    value: Any
    fault: str = ""
    is_lost: bool = False


class Connection:
    """A self-reconnecting connection; one request at a time.

    Attributes:
      address: `ws://HOST:PORT`.
      metadata: the server's greeting. A server with another policy's is not connected to.
      fault: reason of a missing connection, else empty.
      connections: number of connections so far.
    """

    def __init__(self, address: str, api_key: str, timeout_s: float, wait_s: float) -> None:
        """Connects.

        Raises:
          UsageError: no server answers within `wait_s`, or it refuses the key.
        """
        self.address = address if "://" in address else f"ws://{address}"
        self.metadata: dict[str, Any] = {}
        self.fault, self.connections = "no server at this address", 0
        self._api_key, self._timeout_s = api_key, timeout_s
        self._requests: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._replies: queue.SimpleQueue[Reply] = queue.SimpleQueue()
        self._up, self._closing = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._work, name="starjax-connection", daemon=True)
        self._thread.start()
        if not self._up.wait(wait_s):
            self.close()
            raise UsageError("address", "a server of a policy", self.address, self.fault)

    @property
    def is_up(self) -> bool:
        """Returns True if a request can be sent now."""
        return self._up.is_set()

    def send(self, value: dict[str, Any]) -> None:
        """Sends a request; the previous one must have its reply."""
        self._requests.put(wire.pack(value))

    def poll(self) -> Reply | None:
        """Returns the reply to the request, None while it is pending."""
        return self.wait(0.0)

    def wait(self, seconds: float) -> Reply | None:
        """Waits at most `seconds` for the reply."""
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
                socket = connect(self.address, self._api_key, self._timeout_s)
                with socket:
                    self._greet(socket.recv(self._timeout_s))
                    wait_s = _FIRST_WAIT_S
                    self._exchange(socket)
            except FAULTS as error:
                self.fault = str(error) or type(error).__name__
            self._up.clear()
            self._closing.wait(wait_s)
            wait_s = min(2 * wait_s, _MAX_WAIT_S)

    def _greet(self, frame: str | bytes) -> None:
        metadata = wire.unpack(frame)
        if not isinstance(metadata, dict) or metadata.get("protocol") != wire.PROTOCOL:
            raise UsageError("address", f"a server of protocol {wire.PROTOCOL}", self.address)
        digest, before = metadata.get("digest"), self.metadata.get("digest")
        if self.metadata and digest != before:
            raise UsageError("address", f"policy {before} as before reconnecting", digest)
        self.metadata, self.fault = metadata, ""
        self.connections += 1
        while not self._requests.empty():  # sent as the last connection broke: too old
            self._requests.get()
        self._up.set()

    def _exchange(self, socket: sockets.ClientConnection) -> None:
        """Exchanges requests and replies until the connection breaks, which is a reply too."""
        try:
            while (frame := self._next_request(socket)) is not None:
                socket.send(frame)
                self._replies.put(_read(socket.recv(self._timeout_s)))
        except (OSError, websockets.WebSocketException) as error:
            # First down, then the reply: the caller must not send on a broken connection.
            self._up.clear()
            self._replies.put(Reply(None, str(error) or "no answer in time", is_lost=True))
            raise

    def _next_request(self, socket: sockets.ClientConnection) -> bytes | None:
        """Waits for the next request, None at the end; raises if the connection breaks first."""
        while not self._closing.is_set():
            try:
                return self._requests.get(timeout=_POLL_S)
            except queue.Empty:
                if socket.protocol.state is not websockets.State.OPEN:
                    raise ConnectionError("the server has closed the connection") from None
        return None


def connect(
    address: str,
    api_key: str,
    timeout_s: float,
    close_s: float | None = None,
    ping_s: float | None = 20.0,
) -> sockets.ClientConnection:
    """Connects to a server.

    Args:
      address: `ws://HOST:PORT`.
      api_key: of the server, may be empty.
      timeout_s: of the connection.
      close_s: of its end; by default the same.
      ping_s: between two pings; None for none.

    Raises:
      FAULTS: no server answers, or it refuses the key.
    """
    return sockets.connect(
        address,
        additional_headers={"Authorization": f"Api-Key {api_key}"} if api_key else {},
        compression=None,
        proxy=None,  # a control loop never passes through one of the environment
        max_size=MAX_REPLY,
        open_timeout=timeout_s,
        close_timeout=timeout_s if close_s is None else close_s,
        ping_interval=ping_s,
        logger=_SILENT,
    )


def _read(frame: str | bytes) -> Reply:
    if isinstance(frame, str):
        return Reply(None, frame)
    try:
        return Reply(wire.unpack(frame))
    except UsageError as error:
        return Reply(None, str(error))
