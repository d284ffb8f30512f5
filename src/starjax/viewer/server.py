"""The page's server: on this machine only, unless told otherwise, and closed as it was opened."""

import contextlib
import io
from collections.abc import Iterator
from typing import Any

from starjax import errors

HOST = "127.0.0.1"
PORT = 8080
ANY = 0  # a port that the system chooses
_TEAL = (0, 84, 74)


@contextlib.contextmanager
def opened(port: int = PORT, label: str = "starjax", host: str = HOST) -> Iterator[Any]:
    """Yields a `viser.ViserServer`, empty but for its looks.

    Raises:
      errors.UsageError: another program listens there, or nothing may.
    """
    import viser

    with contextlib.redirect_stdout(io.StringIO()):  # its banner; ours is a line
        server = viser.ViserServer(host=host, port=port, label=label, verbose=False)
    try:
        # viser takes the next port that is free, which nobody would think of opening.
        if port not in (ANY, server.get_port()):
            hint = "is another viewer open? --port 0 takes a free one"
            raise errors.UsageError("port", "one that is free", port, hint)
        server.gui.configure_theme(
            brand_color=_TEAL, show_logo=False, show_share_button=False, control_width="medium"
        )
        yield server
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()


def address(server: Any) -> str:
    """Address to open in a browser."""
    return f"http://{server.get_host()}:{server.get_port()}"
