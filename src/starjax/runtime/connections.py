"""Admission of connections to a websocket server: no more than it can hold."""

import socket
from typing import Any

from websockets.asyncio import server as sockets

from starjax.core.errors import UsageError

HANDSHAKE_S = 5.0  # time to finish a handshake
_SPARE = 8  # connections beyond the maximum that get a response instead of being dropped


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
