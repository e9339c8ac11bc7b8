"""The progress of transfers on a terminal: one total, and the file at work. Layer: cli; uses rich."""

from __future__ import annotations

import sys
from contextlib import AbstractContextManager, nullcontext

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from mavftpfs.cli.report import time_left
from mavftpfs.client.progress import Progress
from mavftpfs.shared.readable import printable, readable_size

_REFRESH = 5
_ROOM = 4
"""Columns that stay free: else the terminal's ^C would begin a line that rich does not know of."""
_BAR = 40
_LINE = len("999.9 MB of 999.9 MB, 999.9 kB/s, 59 min 59 s left")
"""Columns of the longest total, for which there is room from the start: the bar keeps its width."""


def totals(progress: Progress) -> str:
    """Return the line of the total."""
    parts = [f"{progress.files_done}/{progress.files} files"] if progress.files > 1 else []
    parts.append(f"{readable_size(progress.done)} of {readable_size(progress.total)}")
    if progress.lost:
        return ", ".join([*parts, "waiting for the vehicle"])
    if progress.rate is not None:
        parts.append(f"{readable_size(progress.rate)}/s")
    if progress.time_left is not None and progress.done < progress.total:
        parts.append(time_left(progress.time_left))
    return ", ".join(parts)


def current(progress: Progress, width: int) -> str:
    """Return the line of the file at work, cut to a width: the end of a name tells more than its start."""
    if not progress.name:
        return ""
    state = "" if progress.lost else progress.state  # the total says it
    if not state and progress.files > 1:
        state = f"{readable_size(progress.here)} of {readable_size(progress.size)}"
    name, room = printable(progress.name), width - len(state) - 2
    if len(name) > room:
        name = "…" + name[-max(room - 1, 1) :]
    return f"{name}  {state}".rstrip()


def bar_width(progress: Progress, width: int) -> int:
    """Return the columns of the bar on a terminal of that width; the same from the first byte to the last."""
    counts = len(f"{progress.files}/{progress.files} files, ") if progress.files > 1 else 0
    return max(8, min(_BAR, width - counts - _LINE - 8))


class _Screen:
    """What rich draws, again and again."""

    def __init__(self, progress: Progress, console: Console, idle: str) -> None:
        self._progress = progress
        self._console = console
        self._idle = idle

    def __rich__(self) -> RenderableType:
        progress, width = self._progress, self._console.width
        if not progress.files:
            return Text(self._idle)
        line = totals(progress)
        share = progress.done / progress.total if progress.total else 1.0
        bar = ProgressBar(total=1.0, completed=share, width=bar_width(progress, width))
        row = Table.grid(padding=(0, 1))
        row.add_row(bar, Text(f"{share * 100:3.0f} %"), Text(line, no_wrap=True))
        return Group(row, Text(current(progress, width - _ROOM), no_wrap=True))


def drawn(progress: Progress, idle: str) -> AbstractContextManager[object]:
    """Draw progress on stderr during the body, if that is a terminal that can be drawn on."""
    console = Console(stderr=True)
    if not console.is_terminal:
        return nullcontext()
    screen = _Screen(progress, console, idle)
    # What goes to stdout would come out on stderr if rich took it; only on one terminal are they the same.
    to_terminal = sys.stdout.isatty()
    return Live(
        screen, console=console, refresh_per_second=_REFRESH, transient=True, redirect_stdout=to_terminal
    )
