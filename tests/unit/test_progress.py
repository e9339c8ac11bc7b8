"""client.progress and cli.drawing: what is counted, and what the lines say."""

from __future__ import annotations

from mavftpfs.cli.drawing import bar_width, current, totals
from mavftpfs.client.progress import Progress
from tests.support.clocks import HandClock


def move(progress: Progress, clock: HandClock, seconds: int, rate: int = 10_000) -> None:
    """Let the file at work move on."""
    for _ in range(seconds):
        clock.now += 1
        progress.at(progress.here + rate)


def test_while_the_vehicle_is_lost_no_speed_is_shown_and_none_of_before_after_it() -> None:
    clock = HandClock(100.0)
    progress = Progress(clock)
    progress.plan(1, 1_000_000)
    progress.begin("/a", 1_000_000)
    move(progress, clock, 6)
    assert totals(progress) == "60.0 kB of 1.0 MB, 10.0 kB/s, 1 min 34 s left"
    progress.check()
    progress.lost = True
    assert totals(progress) == "60.0 kB of 1.0 MB, waiting for the vehicle"
    assert current(progress, 80) == "/a"
    clock.now += 60
    progress.begin("/a", 1_000_000, 60_000)
    progress.lost = False
    move(progress, clock, 4, 5_000)
    assert totals(progress) == "80.0 kB of 1.0 MB, 5.0 kB/s, 3 min 4 s left"


def test_the_end_of_a_long_name_is_shown_and_nothing_a_terminal_obeys() -> None:
    progress = Progress(HandClock(100.0))
    progress.plan(2, 1000)
    progress.begin("/x\x1b[31m" + "y" * 100 + "/log.ulg", 1000)
    line = current(progress, 40)
    assert len(line) == 40
    assert line.startswith("…")
    assert line.endswith("/log.ulg  0 B of 1.0 kB")
    assert "\x1b" not in current(progress, 400)


def test_the_bar_keeps_its_width() -> None:
    clock = HandClock(100.0)
    progress = Progress(clock)
    progress.plan(2, 300_000_000)
    widths, lines = set(), set()
    for name in ("/a", "/b"):
        progress.begin(name, 150_000_000)
        for step in range(1, 11):
            clock.now += 4.0
            progress.at(15_000_000 * step)
            lines.add(len(totals(progress)))
            widths.add(bar_width(progress, 100))
        progress.end(150_000_000)
    assert len(lines) > 3
    assert len(widths) == 1
    assert max(lines) + widths.pop() + 8 <= 100


def test_a_second_plan_begins_anew() -> None:
    progress = Progress(HandClock(100.0))
    for _ in range(2):
        progress.plan(1, 1000)
        progress.begin("/a", 1000)
        assert (progress.done, progress.files_done) == (0, 0)
        progress.at(1000)
        progress.end(1000)
        assert (progress.done, progress.files_done) == (1000, 1)
