"""Work in a background thread begins at once; its result or error arrives at the caller."""

import threading

import pytest

from starjax.runtime import background


def test_work_begins_before_anybody_waits_and_its_result_is_kept():
    begun, may_end = threading.Event(), threading.Event()

    def work():
        begun.set()
        assert may_end.wait(10)
        return threading.current_thread().name

    result = background.run_in_background(work)
    assert begun.wait(10)  # without a waiting caller
    may_end.set()
    assert result() == result() != threading.current_thread().name


def test_what_the_work_raises_is_raised_where_it_is_asked_for():
    result = background.run_in_background(lambda: 1 // 0)
    with pytest.raises(ZeroDivisionError):
        result()
