"""A robot driven by a policy of this process, with the client's checks and its plans ahead of time.

>>> report = deploy.drive(robot, deploy.load("compact"), trocar, seconds=20.0)
"""

import queue
import threading
from collections.abc import Callable
from typing import Any

from jax.typing import ArrayLike

from starjax import rcm
from starjax.core.errors import UsageError
from starjax.deploy import batching, server, wire
from starjax.deploy.client import Client
from starjax.deploy.connection import Reply
from starjax.deploy.plan_executor import Report
from starjax.deploy.policy import Deployed
from starjax.deploy.robot import Robot


def drive(
    robot: Robot,
    policy: Deployed,
    trocar: rcm.Trocar | ArrayLike,
    seconds: float,
    should_stop: Callable[[], bool] = lambda: False,
    **options: Any,
) -> Report:
    """Drives a robot at 30 Hz for `seconds`, or until `should_stop()`.

    The policy plans in a thread, ahead of time, so no command waits for it. All checks are those of
    `Client`: an arm in doubt gets no more commands.

    Args:
      robot: measures and takes commands.
      policy: one that keeps to the RCM manifold.
      trocar: measured trocars: positions `[*arms, 3]` m in the world, or their parameters.
      seconds: of the drive, compiling not counted.
      should_stop: called once per control step.
      options: of `Client`, such as `limits`, `tolerances` and `key`.

    Raises:
      UsageError: as `Client` and its first `step`.
    """
    with Client("", trocar, connect=lambda *_: InProcess(policy), **options) as client:
        return client.run(robot, seconds, should_stop)


class InProcess:
    """A policy of this process in the place of a `Connection` to a server; always up.

    Attributes:
      metadata: as a server's greeting.
    """

    is_up, connections = True, 1

    def __init__(self, policy: Deployed) -> None:
        """Compiles the policy."""
        self.metadata = server.metadata(policy)
        self._spec, self._batches = policy.input_spec, batching.Batches(policy, 1)
        self._batches.warm_up()
        self._requests: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._replies: queue.SimpleQueue[Reply] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._work, name="starjax-policy", daemon=True)
        self._thread.start()

    def send(self, value: dict[str, Any]) -> None:
        """Requests a plan; the previous request must have its reply."""
        self._requests.put(value)

    def poll(self) -> Reply | None:
        """Returns the reply to the request, None while it is pending."""
        try:
            return self._replies.get_nowait()
        except queue.Empty:
            return None

    def close(self) -> None:
        """Ends the thread."""
        self._requests.put(None)
        self._thread.join()

    def _work(self) -> None:
        while (value := self._requests.get()) is not None:
            self._replies.put(self._reply(value))

    def _reply(self, value: dict[str, Any]) -> Reply:
        try:
            request = wire.decode_request(self._spec, value, self._batches.key_size)
            (reply,) = self._batches.infer([request])
        except (ValueError, RuntimeError) as error:  # RuntimeError: of the device
            return Reply(None, str(error))
        return Reply(None, str(reply)) if isinstance(reply, UsageError) else Reply(reply)
