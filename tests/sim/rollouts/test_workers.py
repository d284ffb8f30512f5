"""Simulations side by side: their results, workers, and ends."""

import threading

import jax
import pytest

from starjax.runtime import xla
from starjax.sim.rollouts import workers


def counting(numbers):
    def start(job):
        yield from ((job, i) for i in range(numbers[job]))

    return start


@pytest.mark.parametrize("max_workers", [1, 2, 5])
def test_all_that_jobs_yield_comes_each_jobs_in_its_order(max_workers):
    numbers = {0: 3, 1: 0, 2: 5, 3: 1}
    found = list(workers.run(numbers, counting(numbers), max_workers))
    assert sorted(found) == [(job, i) for job, n in numbers.items() for i in range(n)]
    for job, n in numbers.items():
        assert [i for j, i in found if j == job] == list(range(n))


def test_as_many_are_at_work_together_as_asked_and_no_more():
    together = threading.Barrier(3, timeout=20)
    lock, at_work, most = threading.Lock(), 0, 0

    def start(job):
        nonlocal at_work, most
        with lock:
            at_work += 1
            most = max(most, at_work)
        together.wait()  # limit of three: fewer would break it
        with lock:
            at_work -= 1
        yield job

    assert sorted(workers.run(range(9), start, 3)) == list(range(9))
    assert most == 3


def test_a_job_begins_when_one_before_it_has_ended():
    begun, ended = set(), set()

    def start(job):
        begun.add(job)
        yield from range(5)
        ended.add(job)

    open_jobs = [len(begun - ended) for _ in workers.run(range(6), start, 2)]
    assert begun == ended == set(range(6))
    assert max(open_jobs) == 2


def test_a_job_ends_where_it_is_no_longer_wanted():
    begun, ended, unwanted = [], [], {4}

    def start(job):
        begun.append(job)
        try:
            for i in range(100):
                yield job, i
        finally:
            ended.append(job)

    for job, i in workers.run(range(5), start, 2, lambda job: job not in unwanted):
        if i == job:
            unwanted.add(job)
    assert sorted(begun) == sorted(ended) == [0, 1, 2, 3]


def test_a_failed_job_is_its_callers_error_and_others_go_no_further():
    asked = []

    def start(job):
        if job == 1:
            yield job
            raise ValueError("no lanes")
        for i in range(1000):
            asked.append(i)
            yield i

    with pytest.raises(ValueError, match="no lanes"):
        list(workers.run(range(2), start, 2))
    assert len(asked) < 1000


def test_a_caller_that_leaves_leaves_nobody_at_work():
    before = threading.active_count()
    found = workers.run(range(4), counting(dict.fromkeys(range(4), 100)), 2)
    next(found)
    found.close()
    assert threading.active_count() == before


@pytest.mark.parametrize(
    ("backend", "devices", "expected"), [("cpu", 1, 6), ("cpu", 2, 1), ("gpu", 1, 1)]
)
def test_each_core_of_a_cpu_has_one(monkeypatch, backend, devices, expected):
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    monkeypatch.setattr(jax, "local_devices", lambda: [None] * devices)
    monkeypatch.setattr(xla, "cores", lambda: 6)
    assert workers.worker_count() == expected
