"""The decomposition behind Proposition 1 finds the variances that positions were made with."""

import numpy as np
import pytest

SCENES, TROCARS, POINTS = 4000, 12, 5


@pytest.fixture
def decomposition(monkeypatch, pytestconfig):
    monkeypatch.syspath_prepend(pytestconfig.rootpath / "experiments" / "methods")
    import _decomposition  # from the folder of its study, which is no package

    return _decomposition


def positions(scene, common, own, seed=0, scenes=SCENES):
    """`[S, C, G, 3]` with these variances a coordinate, the trocars' exactly."""
    random = np.random.default_rng(seed)

    def drawn(*shape):
        return random.normal(size=(*shape, 3))

    offset = drawn(1, TROCARS, POINTS)
    offset = (offset - offset.mean(1, keepdims=True)) / offset.std(1, keepdims=True)
    each = drawn(scenes, TROCARS, POINTS)
    each = (each - each.mean(1, keepdims=True)) / each.std(1, keepdims=True)
    return scene**0.5 * drawn(scenes, 1, POINTS) + common**0.5 * offset + own**0.5 * each


@pytest.mark.parametrize(("scene", "common", "own"), [(4, 0, 0), (4, 1, 0), (4, 0, 1), (2, 1, 3)])
def test_variances_are_found(decomposition, scene, common, own):
    found = decomposition.parts(positions(scene, common, own))
    assert found.trocar == pytest.approx(3 * (common + own), rel=0.01)
    assert found.common == pytest.approx(3 * common, abs=0.05)
    assert found.scene == pytest.approx(3 * scene, rel=0.03)
    assert found.share == pytest.approx((common + own) / (common + own + scene), abs=0.01)


def test_few_scenes_are_right_on_average(decomposition):
    few = [decomposition.parts(positions(4, 1, 2, seed, scenes=4)) for seed in range(300)]
    mean = np.mean(few, axis=0)
    np.testing.assert_allclose(mean, [9, 3, 12], rtol=0.06)


def test_the_interval_holds_the_share(decomposition, monkeypatch):
    monkeypatch.setattr(decomposition, "RESAMPLES", 200)
    p = positions(4, 1, 1, scenes=64)
    low, high = decomposition.interval([p], [1.0])
    assert low < decomposition.parts(p).share < high < low + 0.2


def test_what_moves_with_no_trocar_has_a_share_of_nothing(decomposition):
    still = 1e-7 * positions(0, 1, 1, scenes=3)  # m
    assert decomposition.parts(still).share == 0.0 < decomposition.parts(1e3 * still).share


def trial(*passages, scale=1.0):
    """Series of a script at 10 Hz: (phase, s it lasts) each, x grows with progress."""
    rows = []
    for phase, lasts in passages:
        for elapsed in np.arange(1, round(10 * lasts) + 1) / 10:
            rows.append((phase, elapsed, elapsed / lasts, scale * (phase + elapsed / lasts)))
    phase, elapsed, progress, x = map(np.array, zip(*rows, strict=True))
    p = np.stack([x, 0 * x, 0 * x], -1)[:, None]
    return phase, elapsed, progress, p


def test_an_attempt_ends_where_it_starts_over(decomposition):
    found = decomposition.first_attempt(
        *trial((1, 1.0), (2, 0.5), (5, 1.0), (5, 2.0), (0, 1.0), (1, 1.0))
    )
    assert [(s.phase, s.visit, len(s.p)) for s in found] == [
        (1, 0, 10), (2, 0, 5), (5, 0, 10), (5, 1, 20)
    ]  # fmt: skip


def test_pace_is_no_variance_and_a_scene_that_did_not_come_through_is_left_out(decomposition):
    def segments(*passages, scale=1.0):
        return decomposition.first_attempt(*trial(*passages, scale=scale))

    scenes = [
        [segments((1, 1.0), (2, 1.0), scale=k), segments((1, 2.0), (2, 0.5), scale=k)]
        for k in (1.0, 2.0)
    ]
    scenes.append([segments((1, 1.0), (2, 1.0)), segments((1, 1.0))])
    found = decomposition.crossed(scenes)
    assert [len(found[phase][0]) for phase in (1, 2)] == [3, 2]
    for phase in (1, 2):
        parts = decomposition.parts(found[phase][0][:, :, :, 0])
        assert parts.trocar < 1e-5 < parts.scene
