"""Admission of connections to a websocket server: no page but its own, no more than it can hold."""

import contextlib
import http
import ipaddress
import socket
from collections.abc import Iterator
from typing import Any

from websockets.asyncio import server as sockets

from starjax.errors import UsageError

HANDSHAKE_S = 5.0  # time to finish a handshake
MAX_PAGES = 64  # connections to a page, several per tab
_SPARE = 8  # connections beyond the maximum that get a response instead of being dropped
_SCHEMES = ("http", "https")


def is_own(request: Any) -> bool:
    """Returns True for a page that this server sent, and for a program other than a browser.

    A browser sends the origin of the page that connects. The server's own page has the host of the
    request. That host is an address or a name of this machine: another name may lead here by its
    owner's choice (DNS rebinding).
    """
    headers = request.headers
    hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
    if len(hosts) != 1 or len(origins) > 1 or not _is_here(hosts[0]):
        return False
    return not origins or origins[0] in [f"{scheme}://{hosts[0]}" for scheme in _SCHEMES]


def limited(most: int) -> Any:
    """Returns a constructor of connections; those far beyond `most` are dropped at once.

    Unfinished handshakes count: thousands of them would use up the process's open files.
    """

    def create(protocol: Any, server: sockets.Server, **options: Any) -> sockets.ServerConnection:
        connection = sockets.ServerConnection(protocol, server, **options)
        begin = connection.connection_made

        def connection_made(transport: Any) -> None:
            begin(transport)
            if count(connection) > most + _SPARE:
                transport.abort()

        connection.connection_made = connection_made
        return connection

    return create


def bind(host: str, port: int) -> socket.socket:
    """Binds a socket to an address before slow work; clients cannot connect yet.

    Raises:
      UsageError: the address is not available.
    """
    bound = None
    try:
        family, *kind, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        bound = socket.socket(family, *kind)
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        bound.bind(address)
    except OSError as error:
        if bound:
            bound.close()
        raise UsageError("--port", "a free address", f"{host}:{port}", str(error)) from None
    return bound


def count(connection: sockets.ServerConnection) -> int:
    """Returns the number of the server's connections, this one and unfinished ones included."""
    return len(connection.server.handlers)


@contextlib.contextmanager
def only_own_pages() -> Iterator[None]:
    """Restricts websocket servers of other libraries that start within the context."""
    original = sockets.serve

    def serve(*args: Any, process_request: Any = None, **options: Any) -> Any:
        def admit(connection: Any, request: Any) -> Any:
            if not is_own(request):
                return connection.respond(http.HTTPStatus.FORBIDDEN, "expected the own page\n")
            return process_request(connection, request) if process_request else None

        limits = {"create_connection": limited(MAX_PAGES), "open_timeout": HANDSHAKE_S}
        return original(*args, process_request=admit, **options, **limits)

    sockets.serve = serve
    try:
        yield
    finally:
        sockets.serve = original


def _is_here(host: str) -> bool:
    name = host.rsplit(":", 1)[0] if host.rpartition(":")[2].isdecimal() else host
    if name.lower() in ("localhost", socket.gethostname().lower()):
        return True
    try:
        return bool(ipaddress.ip_address(name.strip("[]")))
    except ValueError:
        return False
