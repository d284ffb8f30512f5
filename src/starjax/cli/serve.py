"""`starjax serve`: serves a trained policy over websockets."""

import dataclasses
import ipaddress
import os
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

from starjax.cli import checks, options
from starjax.core import errors
from starjax.core.limits import Count, Positive, Range
from starjax.policies import packaged
from starjax.runtime import jax_start, signals, xla

if TYPE_CHECKING:  # for annotations alone
    from starjax.deploy import server

KEY = checks.API_KEY
DESCRIPTION = f"""Serves a policy over websockets: observations in, commands out.

The protocol is that of openpi: openpi-client and starjax.deploy.Client can connect. Clients send
the key in the environment variable {KEY}, which only local clients can do without.

Examples:
  starjax serve --policy compact
  STARJAX_API_KEY=secret starjax serve --policy policy.safetensors --host 0.0.0.0"""


@dataclasses.dataclass(frozen=True)
class ServeArgs:
    """Flags of the command."""

    policy: str = "compact"  # policy.safetensors, or the name of a packaged policy
    host: str = "127.0.0.1"  # listening address; 0.0.0.0: all networks of this machine
    port: Annotated[int, Range(0, 65535)] = 8000  # listening port; 0: a free one
    batch: Annotated[int, Range(1, 256)] = 4  # maximum robots per inference
    clients: Count = 32  # maximum simultaneous connections
    # maximum distance in m from a measured shaft to its trocar
    max_off_trocar: Positive = 0.003


def main(argv: Sequence[str]) -> int:
    """Serves until a stop."""
    args = options.parse("serve", ServeArgs, argv, DESCRIPTION)
    path, api_key = packaged.find("--policy", args.policy), os.environ.get(KEY, "")
    elsewhere = f"a key for clients of --host {args.host}"
    checks.expect(bool(api_key) or _is_local(args.host), KEY, elsewhere, "none")
    from starjax.runtime import connections

    address = connections.bind(args.host, args.port)  # before anything slow
    xla.prepare_xla()
    jax_start.require_devices("starjax.deploy.server")

    from starjax import deploy
    from starjax.deploy import server

    try:
        policy = deploy.load(path, max_off_trocar=args.max_off_trocar)
    except errors.UsageError:
        raise
    except ValueError as error:
        raise errors.UsageError("--policy", "a policy of starjax", error) from error
    settings = server.ServerSettings(args.host, args.port, args.batch, args.clients)
    print(f"{args.policy}: compiling for batches of up to {args.batch}", flush=True)

    def listening(host: str, port: int) -> None:
        key = f"with the key of {KEY}" if api_key else "without a key"
        print(f"serving at ws://{host}:{port}, {key}; Ctrl-C ends it", flush=True)

    with signals.stop_signals() as should_stop:
        counts = server.run(
            policy,
            settings,
            name=args.policy,
            api_key=api_key,
            should_stop=should_stop,
            listening=listening,
            log=lambda line: print(line, file=sys.stderr, flush=True),
            address=address,
        )
    raise KeyboardInterrupt(_summary(counts))


def _summary(counts: "server.Counts") -> str:
    return (
        f"stopped; {counts.answered} requests of {counts.clients} clients answered in "
        f"{counts.calls} calls, {counts.refused} refused"
    )


def _is_local(host: str) -> bool:
    """Returns True for an address that only this machine can reach."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
