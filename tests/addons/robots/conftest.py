"""One participant of DDS for all tests of a process: a second one counts as another program."""

import pytest


@pytest.fixture(scope="session")
def own_bus():
    """Messages of one test are still the newest ones in the next."""
    import loopback  # needs an extra

    network = loopback.robot_file.Network(loopback.DOMAIN, "lo", use_sim_time=True)
    return loopback.bus.Bus(network)
