"""What is timed."""

import dataclasses

import fakes

from starjax.evaluation import latency
from starjax.models import roll_net


def test_the_roll_network_is_timed_with_what_it_is_told(monkeypatch):
    given, init = [], roll_net.RollNet.init

    def noted(net, key, *inputs):
        given.append([x.shape[-1] for x in inputs])
        return init(net, key, *inputs)

    monkeypatch.setattr(roll_net.RollNet, "init", noted)
    for told in (False, True):
        settings = dataclasses.replace(fakes.TINY, observation="state", roll_observation=told)
        assert latency.roll_ms(settings, calls=1)["n"] >= 1
    assert given[1] == [*given[0], fakes.TINY.state_dim]
