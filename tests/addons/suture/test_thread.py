"""Laws of the thread: distances, energy, rest, the pad, the hole."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax.addons.suture import thread, tridiagonal

PERIOD = 1.0 / 30.0
TAIL = np.array([0.0, 0.0, 0.001], np.float32)
HOLE = thread.Hole(*np.array([[0.0, 0, 0], [0.01, 0, 0]], np.float32), np.ones((), bool))


@jax.jit
def led(start, path, hole=thread.NO_HOLE):
    """Returns the thread after each of the tail's positions `[T, 3]`."""

    def follow(now, tail):
        now = thread.advance(now, tail, hole, 0.0, PERIOD)
        return now, now

    return jax.lax.scan(follow, start, path)[1]


def stretch(p):
    return np.abs(np.asarray(jax.vmap(thread.lengths)(p)) / thread.LINK - 1.0)


def energy(run):
    """Returns the energy of each moment, J per kg."""
    v, z = np.asarray(run.v, float), np.asarray(run.p, float)[..., 2]
    return np.mean(thread.GRAVITY * z + 0.5 * np.sum(v**2, -1), -1)


def test_laid_thread_stays_where_it_is():
    start = thread.laid(jnp.asarray(TAIL), 0.3, 40.0, 0.0)
    assert stretch(start.p[None]).max() < 1e-5
    run = led(start, np.tile(TAIL, (90, 1)))
    np.testing.assert_allclose(run.p[-1], start.p, atol=1e-7)


@pytest.mark.parametrize("curl", [0.0, 60.0])
def test_falling_thread_keeps_its_length_and_loses_energy(curl):
    start = thread.laid(jnp.array([0.0, 0.0, 0.2]), 0.3, curl, 0.2)
    run = led(start, np.tile(start.p[0], (150, 1)))
    assert stretch(run.p).max() < 2.0 * thread.TOLERANCE
    noise = thread.GRAVITY * thread.LENGTH * thread.TOLERANCE  # J/kg, of the links' tolerance
    assert np.diff(energy(run)).max() < noise
    assert np.abs(run.v[-1]).max() < 0.03
    np.testing.assert_allclose(run.p[-1, -1], [0.0, 0.0, 0.05], atol=2e-3)


def test_led_thread_stays_on_the_pad_and_keeps_its_length():
    t = np.arange(300)[:, None] * PERIOD
    way = [0.05 * np.sin(1.3 * t), 0.05 * np.sin(2.1 * t), 0.03 - 0.029 * np.cos(1.7 * t)]
    run = led(thread.laid(jnp.asarray(TAIL), 0.3, 40.0, 0.0), np.concatenate(way, 1))
    assert np.isfinite(run.p).all()
    assert stretch(run.p).max() < 2.0 * thread.TOLERANCE
    assert np.asarray(run.p)[..., 2].min() >= 0.0


def test_slack_thread_lies_in_loops():
    up, over, down = (
        np.linspace(a, b, 40)
        for a, b in (
            ([0.0, 0.0, 0.001], [0.0, 0.0, 0.05]),
            ([0.0, 0.0, 0.05], [0.03, 0.01, 0.05]),
            ([0.03, 0.01, 0.05], [0.03, 0.01, 0.01]),
        )
    )
    way = np.concatenate([up, over, down, np.tile(down[-1:], (60, 1))])
    p = np.asarray(led(thread.laid(jnp.asarray(TAIL), 0.3, 40.0, 0.0), way).p[-1])
    links = np.diff(p, axis=0) / thread.LINK
    bends = np.arccos(np.clip(np.sum(links[1:] * links[:-1], -1), -1.0, 1.0))
    assert bends.max() < 2.0 * thread.MAX_BEND


def test_thread_runs_through_the_hole():
    s = np.linspace(0.0, np.pi, 60)
    under = np.stack([0.005 - 0.005 * np.cos(s), 0 * s, -1e-4 - 0.002 * np.sin(s)], -1)
    away = np.linspace([0.01, 0, 0.001], [0.06, 0.06, 0.08], 150)
    start = thread.laid(jnp.array([-0.002, 0.0, 0.001]), 2.5, 40.0, 0.0)
    run = led(start, np.concatenate([under, away, away[::-1]]), HOLE)
    place, passed, p = (np.asarray(x) for x in (run.place, run.passed, run.p))
    assert set(place[:60]) == {thread.INSIDE} and set(place[60:]) == {thread.THROUGH}
    assert np.diff(passed).min() >= 0.0  # the hole holds the slack thread
    far = np.linalg.norm(away[-1] - HOLE.exit)
    np.testing.assert_allclose(passed[-1], far + thread.channel(HOLE), atol=1e-6)
    above = (p[..., 2] >= 0.0) & (np.arange(thread.POINTS) > 0)
    free = above[:, 1:] & above[:, :-1]
    assert stretch(run.p)[free].max() < 0.05
    waiting = np.arange(thread.POINTS) * thread.LINK > passed[-1]
    assert np.abs(p[-1, waiting, :2]).max() < 0.02  # drawn to the entry


def test_no_hole_before_the_needle_has_come_out():
    under = np.linspace([-0.002, 0, 0.001], [0.003, 0, -0.002], 20)
    start = thread.laid(jnp.array([-0.002, 0.0, 0.001]), 2.5, 40.0, 0.0)
    run = led(start, under, HOLE._replace(is_open=np.zeros((), bool)))
    assert not np.asarray(run.place).any() and not np.asarray(run.passed).any()


@pytest.mark.parametrize("solve", [tridiagonal.in_turn, tridiagonal.at_once])
@pytest.mark.parametrize("count", [1, 2, 31])
def test_tridiagonal_systems(solve, count):
    rng = np.random.default_rng(count)
    a, c, d = rng.uniform(-1.0, 1.0, (3, count)).astype(np.float32)
    a[0] = c[-1] = 0.0
    b = (1.1 + np.abs(a) + np.abs(c)).astype(np.float32)
    dense = np.diag(b) + np.diag(c[:-1], 1) + np.diag(a[1:], -1)
    np.testing.assert_allclose(solve(a, b, c, d), np.linalg.solve(dense, d), rtol=2e-5, atol=1e-6)
