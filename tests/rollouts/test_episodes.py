import jax
import numpy as np
import pytest

from starjax.rollouts import episodes


@pytest.mark.parametrize("backend", ["cpu", "gpu"])
def test_fetched_pictures_are_right_and_hold_no_pinned_memory(monkeypatch, backend):
    keys = jax.random.split(jax.random.key(0), 20)
    pictures = [jax.random.bits(key, (4, 8, 8, 3), np.uint8) for key in keys]
    expected = [np.asarray(picture) for picture in pictures]
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    fetched = episodes.fetch(pictures)
    np.testing.assert_array_equal(fetched, expected)
    assert all(picture.flags.owndata for picture in fetched) == (backend == "gpu")
