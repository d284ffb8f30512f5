"""Loops of a throw end: their conditions hold no floating-point arithmetic."""

import loops


def test_no_loop_of_a_throw_has_a_condition_of_floats():
    found = loops.conditions("suture_throw")
    assert len(found) >= 3  # solver, hole and patch, thread
    assert not any(map(loops.with_floats, found))
