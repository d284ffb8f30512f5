"""What is timed."""

import dataclasses

import fakes
import pytest

from starjax.core.methods import METHODS
from starjax.evaluation import latency
from starjax.policies import features
from starjax.policies.models import roll_net

SEEN = features.select_sensors(fakes.TASK)


def test_the_roll_network_is_timed_with_what_it_is_told(monkeypatch):
    given, init = [], roll_net.RollNet.init

    def noted(net, key, *inputs):
        given.append([x.shape[-1] for x in inputs])
        return init(net, key, *inputs)

    monkeypatch.setattr(roll_net.RollNet, "init", noted)
    for told in (False, True):
        settings = dataclasses.replace(fakes.TINY, observation="state", roll_observation=told)
        assert latency.roll_ms(settings, SEEN, calls=1)["n"] >= 1
    assert given[1] == [*given[0], fakes.TINY.state_dim]


def test_percentiles_are_named_by_what_they_are(monkeypatch):
    now, taken = [0.0], iter([9.0] * latency._WARM_UP + [1e-3 * ms for ms in range(1, 101)])

    def call():
        now[0] += next(taken)

    monkeypatch.setattr(latency.time, "perf_counter", lambda: now[0])
    found = latency._percentiles(call, calls=100, seconds=1e9)
    times = [found[name] for name in ("p50", "p95", "p99")]
    assert times == pytest.approx([50.5, 95.05, 99.01], abs=0.01) and found["n"] == 100


def test_every_row_of_the_table_has_its_own_sampler(monkeypatch):
    made = []
    monkeypatch.setattr(latency.policies, "make", lambda _, chosen, *__, **___: made.append(chosen))
    monkeypatch.setattr(latency, "policy_ms", lambda *_, **__: {})
    given = METHODS["stardiff"], fakes.TINY, None, None, SEEN
    rows = list(latency.table(*given, ddim_steps=(1, 5)))
    steps = [chosen.options.ddim_steps for chosen in made]
    assert steps == [row["ddim_steps"] for row in rows] == [1, 5]


def test_a_slow_policy_is_timed_five_times_until_its_answer_is_there(monkeypatch):
    now = [0.0]

    class Late:
        def block_until_ready(self):
            now[0] += 2.0

    monkeypatch.setattr(latency.time, "perf_counter", lambda: now[0])
    found = latency._percentiles(Late, calls=100, seconds=1.0)
    assert found == {"p50": 2000.0, "p95": 2000.0, "p99": 2000.0, "n": 5}
