"""Admission of browsers to the page of a library's server."""

import contextlib
import http
import ipaddress
import socket
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import websockets
from websockets.asyncio import server as sockets

from starjax.runtime import connections

MAX_PAGES = 64  # connections to a page, several per tab
_SCHEMES = ("http", "https")


def refusal(request: websockets.Request, names: Sequence[str] = ()) -> str:
    """Returns why a request comes from a foreign page, empty for the own page and for programs.

    A browser sends the origin of the page that connects. The server's own page has the host of the
    request. That host is an address or a name of this machine: another name may lead here by its
    owner's choice (DNS rebinding).

    Args:
      request: of a websocket or a page.
      names: further names of this machine, as a proxy or a domain gives it.
    """
    headers, allowed = request.headers, [name.lower() for name in names]
    hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
    if len(hosts) != 1 or len(origins) > 1:
        return "expected one Host and at most one Origin"
    host = _name(hosts[0])
    if not _is_here(host) and host not in allowed:
        return f"{host} is no name of this machine; --allow-host {host} admits it"
    if not origins or origins[0] in [f"{scheme}://{hosts[0]}" for scheme in _SCHEMES]:
        return ""
    scheme, _, origin = origins[0].partition("://")
    if scheme in _SCHEMES and _name(origin) in allowed:  # a proxy may send its own Host
        return ""
    return f"a page of {origins[0]} is not the own page; --allow-host {_name(origin)} admits it"


@contextlib.contextmanager
def only(
    names: Sequence[str] = (), adapt: Callable[[Any], Any] = lambda response: response
) -> Iterator[None]:
    """Restricts websocket servers of other libraries that start within the context.

    Args:
      names: see `refusal`.
      adapt: response of the server to a request for a file -> the one that is sent.
    """
    original = sockets.serve

    def serve(*args: Any, process_request: Any = None, **options: Any) -> Any:
        def admit(connection: sockets.ServerConnection, request: websockets.Request) -> Any:
            if why := refusal(request, names):
                return connection.respond(http.HTTPStatus.FORBIDDEN, f"{why}\n")
            response = process_request(connection, request) if process_request else None
            return response and adapt(response)

        limits = {
            "create_connection": connections.limited(MAX_PAGES),
            "open_timeout": connections.HANDSHAKE_S,
        }
        return original(*args, process_request=admit, **options, **limits)

    sockets.serve = serve
    try:
        yield
    finally:
        sockets.serve = original


def _name(host: str) -> str:
    """Returns a host without its port, in lower case."""
    return (host.rsplit(":", 1)[0] if host.rpartition(":")[2].isdecimal() else host).lower()


def _is_here(name: str) -> bool:
    if name in ("localhost", socket.gethostname().lower()):
        return True
    try:
        return bool(ipaddress.ip_address(name.strip("[]")))
    except ValueError:
        return False
