"""A user who waits for a compiler reads one line about it."""

import time

import jax
import jax.numpy as jnp
import pytest

from starjax.runtime import notice, precompile


@pytest.fixture
def lines(monkeypatch):
    monkeypatch.setattr(notice, "AFTER_S", 0.05)
    monkeypatch.setattr(notice, "_reports", [])
    reported = []
    notice.once(lambda: reported.append(len(reported)))
    return reported


def slow(x):
    time.sleep(0.2)
    return 2.0 * x


def test_a_slow_trace_is_reported_once(lines):
    for size in (1, 2):
        precompile.Program(slow)(jnp.ones(size))
    assert lines == [0]


def test_a_quick_one_and_slow_calls_are_not(lines, monkeypatch):
    program = precompile.Program(lambda x: 2.0 * x)
    monkeypatch.setattr(notice, "AFTER_S", 5.0)
    program(jnp.ones(1))
    monkeypatch.setattr(notice, "AFTER_S", 0.05)
    with notice.call():
        program(jnp.ones(1))
        time.sleep(0.2)
    assert lines == []


def test_a_wait_for_the_background_is(lines):
    program = precompile.Program(slow)
    wait = precompile.start(lambda: program.prepare(jax.ShapeDtypeStruct((3,), jnp.float32)))
    wait()
    compiled = precompile.Future()
    precompile._compilers.submit(lambda: time.sleep(0.2) or compiled.set_result(slow))
    assert precompile._awaited(compiled) is slow
    assert lines == [0]


def test_a_process_that_asked_for_nothing_hears_nothing(monkeypatch):
    monkeypatch.setattr(notice, "_reports", [])
    monkeypatch.setattr(notice.threading, "Timer", pytest.fail)
    precompile.Program(slow)(jnp.ones(1))
