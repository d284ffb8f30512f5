"""Weighted points in place of a needle's contacts with a pad."""

from types import SimpleNamespace

import numpy as np


def test_four_weighted_points_have_the_sums_and_moments_of_all(monkeypatch, pytestconfig):
    monkeypatch.syspath_prepend(pytestconfig.rootpath / "benchmarks")
    import bench_contacts

    rng = np.random.default_rng(0)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    place = np.column_stack([rng.normal(size=(11, 2)) * (3e-3, 1e-3), np.zeros(11)])  # in a face
    depth = 1e-4 * (1.0 + place @ (100.0, 200.0, 0.0))
    data = SimpleNamespace(contact=SimpleNamespace(pos=place @ turn.T + 0.1, dist=-depth))
    kept = list(bench_contacts._moments(data, [(i, 7) for i in range(11)]).values())
    w, p, d = (np.array(x) for x in zip(*((x.weight, x.p, x.dist) for x in kept)))
    whole = np.column_stack([np.ones(11), data.contact.pos])  # 1 and the place
    part = np.column_stack([np.ones(4), p])
    np.testing.assert_allclose(part.T * w @ part, whole.T @ whole, rtol=1e-9)
    np.testing.assert_allclose(part.T * w @ d, whole.T @ data.contact.dist, rtol=1e-9)
