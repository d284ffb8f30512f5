"""`starjax serve --policy NAME`: a trained policy for clients elsewhere."""

import dataclasses
import ipaddress
import os
from collections.abc import Sequence
from typing import Annotated, Any

from starjax.commands import checks, options
from starjax.limits import Count, Range
from starjax.policies import packaged
from starjax.runtime import signals, xla

KEY = "STARJAX_API_KEY"
DESCRIPTION = f"""Answers robots over websockets: observation in, commands out.

The protocol is openpi's, so that openpi-client and starjax.deploy.Client can talk to it. Clients
must know the key in the environment variable {KEY}, which may be unset for this machine alone."""


@dataclasses.dataclass(frozen=True)
class ServeArgs:
    """Flags of the command."""

    policy: str = "compact"  # a policy.safetensors, or the name of one that ships with starjax
    host: str = "127.0.0.1"  # address to listen at; 0.0.0.0 is every network of this machine
    port: Annotated[int, Range(0, 65535)] = 8000  # 0: any that is free
    batch: Annotated[int, Range(1, 256)] = 4  # robots that one call decides for, at most
    clients: Count = 32  # connections at once, at most


def main(argv: Sequence[str]) -> int:
    """Serves until it is stopped."""
    args = options.parse("serve", ServeArgs, argv, DESCRIPTION)
    path, api_key = packaged.find("--policy", args.policy), os.environ.get(KEY, "")
    elsewhere = f"a key for clients of --host {args.host}"
    checks.expect(bool(api_key) or _is_here(args.host), KEY, elsewhere, "none")
    xla.prepare_xla()
    xla.require_devices("starjax.deploy.server")

    from starjax import deploy
    from starjax.deploy import server

    policy = deploy.load(path)
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
        )
    raise KeyboardInterrupt(_said(counts))


def _said(counts: Any) -> str:
    return (
        f"stopped; {counts.answered} requests of {counts.clients} clients answered in "
        f"{counts.calls} calls, {counts.refused} refused"
    )


def _is_here(host: str) -> bool:
    """Whether only programs of this machine reach an address."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
