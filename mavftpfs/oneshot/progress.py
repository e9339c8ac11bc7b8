"""The progress of transfers on a terminal: one total, and the file at work. Layer: top; uses rich.

Only bytes that are safe are counted: those that came, or those that the vehicle acknowledged.
"""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from mavftpfs.shared.readable import printable, readable_size, readable_time

RATE_SPAN = 10.0
"""Seconds over which the rate is measured."""
_REFRESH = 5
_ROOM = 4
"""Columns that stay free: the terminal's ^C would else begin a line of which rich does not know."""
_BAR = 40
_SAMPLE = 0.2


class Progress:
    """Counts; shows nothing by itself. All sizes in bytes."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._samples: deque[tuple[float, int]] = deque()
        self.files = self.files_done = 0
        self.total = self._ended = self._moved = 0
        self.name = ""
        self.size = self.here = 0
        self.state = ""

    def plan(self, files: int, total: int) -> None:
        """Say how much there is to do in all."""
        self.files, self.total = files, total

    def begin(self, name: str, size: int, here: int = 0) -> None:
        """Begin a file, or begin it again; `here` bytes of it need not move."""
        self.name, self.size, self.here, self.state = name, size, here, ""
        self._sample()

    def at(self, here: int) -> None:
        """So many bytes of the file are safe."""
        self._moved += max(0, here - self.here)
        self.here = here
        self.size = max(self.size, here)
        self._sample()

    def check(self) -> None:
        """All bytes moved; what came is compared."""
        self.state = "checking"

    def wait(self) -> None:
        """The vehicle is lost."""
        self.state = "waiting for the vehicle"

    def end(self, planned: int) -> None:
        """The file is through, well or not; `planned`: its bytes in the plan."""
        self._ended += planned
        self.files_done += 1
        self.size = self.here = 0
        self.name = self.state = ""

    @property
    def done(self) -> int:
        """Bytes of the plan that are done."""
        return min(self._ended + self.here, self.total)

    @property
    def rate(self) -> float | None:
        """Bytes per second that move, None before it is known."""
        if len(self._samples) < 2:
            return None
        (began, before), now = self._samples[0], self._clock()
        return (self._moved - before) / (now - began) if now - began >= 1.0 else None

    @property
    def time_left(self) -> float | None:
        """Seconds until all is done, None while unknown."""
        return (self.total - self.done) / self.rate if self.rate else None

    def _sample(self) -> None:
        now = self._clock()
        if not self._samples or now - self._samples[-1][0] >= _SAMPLE:
            self._samples.append((now, self._moved))
        while now - self._samples[0][0] > RATE_SPAN and len(self._samples) > 2:
            self._samples.popleft()


def totals(progress: Progress) -> str:
    """Return the line of the total."""
    parts = [f"{progress.files_done}/{progress.files} files"] if progress.files > 1 else []
    parts.append(f"{readable_size(progress.done)} of {readable_size(progress.total)}")
    if progress.rate is not None:
        parts.append(f"{readable_size(progress.rate)}/s")
    if progress.time_left is not None and progress.done < progress.total:
        parts.append(f"{readable_time(max(1.0, progress.time_left))} left")
    return ", ".join(parts)


def current(progress: Progress, width: int) -> str:
    """Return the line of the file at work, cut to a width: the end of a name tells more than its start."""
    if not progress.name:
        return ""
    state = progress.state
    if not state and progress.files > 1:
        state = f"{readable_size(progress.here)} of {readable_size(progress.size)}"
    name, room = printable(progress.name), width - len(state) - 2
    if len(name) > room:
        name = "…" + name[-max(room - 1, 1) :]
    return f"{name}  {state}".rstrip()


class _Screen:
    """What rich draws, again and again."""

    def __init__(self, progress: Progress, console: Console) -> None:
        self._progress = progress
        self._console = console

    def __rich__(self) -> RenderableType:
        progress, width = self._progress, self._console.width
        if not progress.files:
            return Text("looking at what is there")
        line = totals(progress)
        share = progress.done / progress.total if progress.total else 1.0
        bar = ProgressBar(total=1.0, completed=share, width=max(8, min(_BAR, width - len(line) - 8)))
        row = Table.grid(padding=(0, 1))
        row.add_row(bar, Text(f"{share * 100:3.0f} %"), Text(line, no_wrap=True))
        return Group(row, Text(current(progress, width - _ROOM), no_wrap=True))


@contextmanager
def shown(progress: Progress) -> Iterator[Progress]:
    """Show progress on stderr during the body, if that is a terminal; nothing of it stays at the end."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield progress
        return
    screen = _Screen(progress, console)
    # What goes to stdout would come out on stderr if rich took it; only on one terminal are they the same.
    to_terminal = sys.stdout.isatty()
    live = Live(
        screen, console=console, refresh_per_second=_REFRESH, transient=True, redirect_stdout=to_terminal
    )
    with live:
        yield progress
