"""The collector pauses inside the block, and only there; who had disabled it, still has."""

import gc
import weakref

import pytest

from starjax.runtime import stored


class _Circle:
    def __init__(self):
        self.itself = self


def test_nothing_is_collected_meanwhile():
    with stored.gc_paused():
        watched = weakref.ref(_Circle())
        made = [[] for _ in range(50 * gc.get_threshold()[0])]
        assert watched() is not None and made
    assert gc.isenabled()
    gc.collect()
    assert watched() is None


def test_a_failure_ends_it():
    with pytest.raises(ZeroDivisionError), stored.gc_paused():
        _ = 1 // 0
    assert gc.isenabled()


def test_who_collects_nothing_goes_on_so():
    gc.disable()
    try:
        with stored.gc_paused():
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()
