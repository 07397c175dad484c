"""Bars show rate, remaining time and a note, also of work whose parts take minutes."""

from __future__ import annotations

import pytest

from gpe_pl.system.progress import Pace, no_bar, progress_bar


class Clock:
    """Clock that a test sets."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def pace_of(*updates: tuple[float, int]) -> tuple[Pace, Clock]:
    clock = Clock()
    pace = Pace(clock)
    for clock.now, done in updates:
        pace.update(done)
    return pace, clock


def test_work_done_before_a_resumed_command_began_does_not_count() -> None:
    pace, _ = pace_of((0.0, 1000), (10.0, 1050))
    assert (pace.rate(), pace.remaining(1100)) == ("5/s", "0:00:10")


def test_parts_that_take_minutes_have_a_rate_and_the_remaining_time_falls_between_them() -> None:
    pace, clock = pace_of((0.0, 0), (120.0, 1), (240.0, 2))
    assert (pace.rate(), pace.remaining(8)) == ("120 s each", "0:12:00")
    assert pace_of((0.0, 0), (1140.0, 1))[0].rate() == "1140 s each"
    assert pace_of((0.0, 0), (5.0, 2))[0].rate() == "2.5 s each"
    clock.now = 300.0
    assert pace.remaining(8) == "0:11:00"
    clock.now = 4000.0
    assert pace.remaining(8) == "0:00:00"


def test_the_rate_is_that_of_the_last_seconds() -> None:
    slow, fast = [(float(t), t) for t in range(100)], [(100.0 + t / 4, 100 + t) for t in range(200)]
    pace, _ = pace_of(*slow, *fast)
    assert pace.per_second == pytest.approx(4.0, rel=0.02)


def test_updates_of_one_moment_count_as_one() -> None:
    pace, _ = pace_of(*[(k / 1000, k) for k in range(10_000)])
    assert len(pace._updates) < 110
    assert pace.per_second == pytest.approx(1000.0, rel=0.01)


def test_nothing_is_known_before_the_second_update() -> None:
    assert Pace().remaining(5) == pace_of((1.0, 3))[0].remaining(5) == "-:--:--"
    assert Pace().rate() == ""


def test_a_bar_shows_label_count_and_note(capsys: pytest.CaptureFixture[str]) -> None:
    with progress_bar("sand [x]", lambda: "loss 0.25") as on_progress:
        on_progress(3, 4)
    shown = capsys.readouterr().out
    assert "sand [x]" in shown and "3/4" in shown and "loss 0.25" in shown
    with no_bar("sand") as on_progress:
        on_progress(3, 4)
    assert capsys.readouterr().out == ""
