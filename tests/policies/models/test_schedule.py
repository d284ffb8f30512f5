"""The noise schedule against its closed form in float64."""

import math

import numpy as np
import pytest

from starjax.policies.models import schedule


def alpha_bar_closed_form(k: int, steps: int) -> float:
    """cos^2 at (k + 1) / K over cos^2 at 0, to which the product of (1 - beta) telescopes."""
    cosine = math.cos(((k + 1) / steps + 0.008) / 1.008 * math.pi / 2) ** 2
    return cosine / math.cos(0.008 / 1.008 * math.pi / 2) ** 2


def test_alpha_bar_is_the_closed_form():
    table = schedule.cosine(100)
    # The last beta is capped, so the closed form (0) holds for all steps but that one.
    expected = [alpha_bar_closed_form(k, 100) for k in range(99)]
    np.testing.assert_allclose(table.sqrt_alpha_bar[:99].astype(float) ** 2, expected, rtol=3e-7)
    assert table.beta[99] == np.float32(0.999)
    assert table.sqrt_alpha_bar[99] == pytest.approx(4.9e-4, rel=0.02)


def test_signal_and_noise_have_unit_variance_together():
    table = schedule.cosine(100)
    total = (
        table.sqrt_alpha_bar.astype(float) ** 2 + table.sqrt_one_minus_alpha_bar.astype(float) ** 2
    )
    np.testing.assert_allclose(total, 1.0, atol=2e-7)
    assert (np.diff(table.sqrt_alpha_bar) < 0).all()


@pytest.mark.parametrize(("steps", "first", "stride"), [(10, 90, 10), (100, 99, 1), (1, 0, 100)])
def test_ddim_steps_are_leading(steps, first, stride):
    table = schedule.ddim_table(100, steps)
    np.testing.assert_array_equal(table.k, first - stride * np.arange(steps))
    assert table.sqrt_alpha_bar_next[-1] == 1.0
    assert table.sqrt_one_minus_alpha_bar_next[-1] == 0.0
    np.testing.assert_array_equal(table.sqrt_alpha_bar_next[:-1], table.sqrt_alpha_bar[1:])
    np.testing.assert_array_equal(
        table.sqrt_alpha_bar, schedule.cosine(100).sqrt_alpha_bar[table.k]
    )


@pytest.mark.parametrize("steps", [7, 34, 51, 99])
def test_ddim_steps_that_do_not_divide_the_schedule_cover_it(steps):
    k = schedule.ddim_table(100, steps).k
    apart = -np.diff(np.append(k, 0))
    assert k[0] >= 100 - 100 / steps - 1 and k[-1] == 0
    assert set(apart[:-1]) <= {100 // steps, 100 // steps + 1}


@pytest.mark.parametrize("steps", [0, 101])
def test_ddim_steps_out_of_range(steps):
    with pytest.raises(ValueError, match=rf"steps: expected 1\.\.100.*got {steps}"):
        schedule.ddim_table(100, steps)


def test_a_schedule_has_steps():
    with pytest.raises(ValueError, match="at least 1 diffusion step, got 0"):
        schedule.cosine(0)
