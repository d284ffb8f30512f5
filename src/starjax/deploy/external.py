"""Policies of other packages in the environment, by the interface of served policies."""

import threading
from collections.abc import Sequence
from typing import Any

import numpy as np

from starjax.core import errors, sources
from starjax.deploy import connection_pool, served
from starjax.policies import in_env
from starjax.policies.external import POLICIES, ExternalPolicy
from starjax.runtime import user_code


class LocalConnection:
    """A policy of this process in place of a server's connections.

    Attributes:
      address: `policy://NAME`.
      metadata: a greeting with the policy's observation and scene.
    """

    def __init__(self, name: str, policy: ExternalPolicy) -> None:
        """Builds the policy; raises errors.UsageError if its `make` fails."""
        self.address, self._part = f"policy://{name}", f"policy {name}"
        made = user_code.guarded(self._part, "make", policy.make)()
        if not callable(getattr(made, "act", None)):
            got = f"a {type(made).__name__} without act"
            raise connection_pool.LostServer(self._part, "an object with act(observation)", got)
        self._act, self._lock = user_code.guarded(self._part, "act", made.act), threading.Lock()
        self.metadata: dict[str, Any] = {
            "observation": policy.observation,
            "image_size": policy.image_size,
            "scene": {
                "task": policy.task,
                **{key: list(getattr(policy, key)) for key in ("arms", "tools", "cameras")},
            },
            **({"execute": policy.execute} if policy.execute else {}),
            "packages": sources.packages([sources.identity(POLICIES, name)]),
            **sources.record([sources.identity(POLICIES, name)]),
        }

    def widen(self, count: int) -> None:
        """Does nothing: calls come one after another."""

    def ask(self, request: dict[str, Any]) -> dict[str, np.ndarray]:
        """Returns the actions of an observation.

        Raises:
          connection_pool.LostServer: names the function and its place.
        """
        with self._lock:
            try:
                actions = self._act(request)
            except errors.UsageError as error:  # a policy that fails ends the evaluation
                fault = (error.argument, error.expected, error.got)
                raise connection_pool.LostServer(*fault) from error
        return {"actions": np.asarray(actions)}


def connect(name: str, arms: Sequence[str] = ()) -> in_env.PolicyInEnv:
    """Returns a policy of `POLICIES` in its environment, after one plan as a test.

    Args:
      arms: robots instead of the policy's.

    Raises:
      errors.UsageError: it cannot be made, or its plan is invalid.
    """
    return served.attach(LocalConnection(name, POLICIES.get(name)), arms)
