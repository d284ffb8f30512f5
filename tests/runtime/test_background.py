"""Work beside other work: it has begun before anybody asks, and what it raises is raised there."""

import threading

import pytest

from starjax.runtime import background


def test_work_goes_on_beside_and_its_result_is_kept():
    begun, may_end = threading.Event(), threading.Event()

    def work():
        begun.set()
        assert may_end.wait(10)
        return threading.current_thread().name

    result = background.beside(work)
    assert begun.wait(10)  # while nobody waits for it
    may_end.set()
    assert result() == result() != threading.current_thread().name


def test_what_the_work_raises_is_raised_where_it_is_asked_for():
    result = background.beside(lambda: 1 // 0)
    with pytest.raises(ZeroDivisionError):
        result()
