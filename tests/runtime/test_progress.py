"""Progress shows counts, throughput and time left, with and without a terminal."""

import io

from starjax.runtime import progress


def _shown(stream, monkeypatch, every=0.0, done=0):
    monkeypatch.setattr(progress, "PLAIN_EVERY_S", every)
    with progress.track("Collect", 4, unit="episodes", done=done, stream=stream) as advance:
        for _ in range(4 - done):
            advance(1, note="30 of 30 succeeded")
    return stream.getvalue()


def test_plain_lines_off_a_terminal(monkeypatch):
    begun, *shown = _shown(io.StringIO(), monkeypatch).splitlines()
    assert begun == "Collect: 0/4 episodes" and len(shown) == 4
    assert shown[0].startswith("Collect: 1/4 episodes") and "ETA" not in shown[0]
    assert "ETA" in shown[1]
    assert "episodes/s" in shown[-1] and "ETA" not in shown[-1] and shown[-1].endswith("succeeded")


def test_plain_lines_are_rare_but_the_first_and_the_last_are_shown(monkeypatch):
    assert len(_shown(io.StringIO(), monkeypatch, every=1e9).splitlines()) == 2


def test_the_last_plain_line_is_shown_once():
    stream = io.StringIO()
    with progress.track("Collect", 4, stream=stream) as advance:
        advance(4)
        advance(0)
    assert len(stream.getvalue().splitlines()) == 2


def test_shares_that_add_up_to_a_little_less_reach_the_end():
    stream = io.StringIO()
    with progress.track("Evaluation", 1, stream=stream) as advance:
        for _ in range(10):
            advance(0.1)
    assert len(stream.getvalue().splitlines()) == 2


def test_a_bar_on_a_terminal(monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    shown = _shown(Terminal(), monkeypatch)
    assert "Collect" in shown and "4/4 episodes" in shown


def test_neither_earlier_work_nor_the_first_piece_counts_for_the_time_left(monkeypatch):
    now = 0.0
    monkeypatch.setattr(progress.time, "monotonic", lambda: now)
    meter = progress._Meter(1000, 900)
    now = 50.0
    meter.add(10)
    assert meter.per_second() == 0.2 and meter.eta() == ""
    now = 51.0
    meter.add(5)
    assert meter.per_second() == 5.0
    assert meter.eta() == "ETA 0:17"
    now = 100.0
    meter.add(85)
    assert meter.per_second() == 1.0  # sum of all, in the end
