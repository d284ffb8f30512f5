"""Environments that the viewer's tests share: the real simulator, `reach`, states instead of
pictures."""

import pytest

from starjax.addons.viewer import recorder, simulation
from starjax.sim import env as sim_env
from starjax.sim.rollouts import agent


@pytest.fixture(scope="session")
def env():
    return sim_env.make("reach", observation="state", image_size=32)


@pytest.fixture(scope="session")
def expert(env):
    """The closed loop of the scripted expert."""
    return simulation.make("expert", env, agent.from_single(env.task.expert()))


@pytest.fixture(scope="session")
def steered(env):
    """The same environment, steered by an operator."""
    return recorder.steer(env)
