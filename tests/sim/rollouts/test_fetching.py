import jax
import numpy as np
import pytest

from starjax.sim.rollouts import fetching


@pytest.mark.parametrize("backend", ["cpu", "gpu"])
def test_fetched_images_are_right_and_hold_no_pinned_memory(monkeypatch, backend):
    keys = jax.random.split(jax.random.key(0), 20)
    images = [jax.random.bits(key, (4, 8, 8, 3), np.uint8) for key in keys]
    expected = [np.asarray(image) for image in images]
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    fetched = fetching.fetch(images)
    np.testing.assert_array_equal(fetched, expected)
    assert all(image.flags.owndata for image in fetched) == (backend == "gpu")
