"""Drawing on a terminal: progress, the status, a line that changes. Layer: cli; all of it by rich.

rich takes a tenth of a second to import, so each function imports what it draws with.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, NoReturn

from mavftpfs.shared.readable import printable, readable_size, time_left

if TYPE_CHECKING:
    from rich.console import RenderableType

    from mavftpfs.client.progress import Progress

_REFRESH = 5
_ROOM = 4
"""Columns that stay free, because the terminal's ^C would otherwise begin a line that rich does not
expect."""
_BAR = 40
_LINE = len("999.9 MB of 999.9 MB, 999.9 kB/s, 59 min 59 s left")
"""Columns of the longest total, reserved from the start, so that the bar keeps its width."""


def totals(progress: Progress) -> str:
    """Return the line with the totals."""
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
    """Return the line of the current file, cut to a width at its start, because a name's end says more."""
    if not progress.name:
        return ""
    state = "" if progress.lost else progress.state  # the line with the totals says so
    if not state and progress.files > 1:
        state = f"{readable_size(progress.here)} of {readable_size(progress.size)}"
    name, room = printable(progress.name), width - len(state) - 2
    if len(name) > room:
        name = "…" + name[-max(room - 1, 1) :]
    return f"{name}  {state}".rstrip()


def bar_width(progress: Progress, width: int) -> int:
    """Return the bar's columns on a terminal of that width; they stay the same from first to last byte."""
    counts = len(f"{progress.files}/{progress.files} files, ") if progress.files > 1 else 0
    return max(8, min(_BAR, width - counts - _LINE - 8))


def _picture(progress: Progress, idle: str, width: int) -> RenderableType:
    """Return the totals and the current file."""
    from rich.console import Group
    from rich.progress_bar import ProgressBar
    from rich.table import Table
    from rich.text import Text

    if not progress.files:
        return Text(idle)
    share = progress.done / progress.total if progress.total else 1.0
    bar = ProgressBar(total=1.0, completed=share, width=bar_width(progress, width))
    row = Table.grid(padding=(0, 1))
    row.add_row(bar, Text(f"{share * 100:3.0f} %"), Text(totals(progress), no_wrap=True))
    return Group(row, Text(current(progress, width - _ROOM), no_wrap=True))


@contextmanager
def shown(progress: Progress, idle: str = "looking for files") -> Iterator[Progress]:
    """Draw progress on stderr during the body, if stderr is a terminal, and erase it at the end.

    idle: the line while nothing is planned.
    """
    if not sys.stderr.isatty():
        yield progress
        return
    from rich.console import Console
    from rich.live import Live

    console = Console(stderr=True)
    # rich would print stdout's lines on stderr; that is right only if both are the same terminal.
    with Live(
        get_renderable=lambda: _picture(progress, idle, console.width),
        console=console,
        refresh_per_second=_REFRESH,
        transient=True,
        redirect_stdout=sys.stdout.isatty(),
    ):
        yield progress


def watch(lines: Callable[[], Sequence[str]], period: float) -> NoReturn:
    """Draw lines on stdout, and redraw them each `period` seconds, until interrupted; the last picture stays.
    Lines that are not indented are bold."""
    from rich.console import Group
    from rich.live import Live
    from rich.text import Text

    with Live(auto_refresh=False) as live:
        while True:
            texts = [Text(line, "" if line.startswith(" ") else "bold") for line in lines()]
            live.update(Group(*texts), refresh=True)
            time.sleep(period)


@contextmanager
def changing_line(say: Callable[[str], None], pause: float) -> Iterator[Callable[[str], None]]:
    """Return a function that shows a line on stderr, in place of its previous line.

    If stderr is no terminal, the function calls `say` with the line, at most each `pause` seconds.
    """
    if not sys.stderr.isatty():
        said_at = float("-inf")

        def say_seldom(line: str) -> None:
            nonlocal said_at
            if time.monotonic() >= said_at + pause:
                said_at = time.monotonic()
                say(line)

        yield say_seldom
        return
    from rich.console import Console
    from rich.live import Live
    from rich.text import Text

    with Live(console=Console(stderr=True), auto_refresh=False) as live:
        yield lambda line: live.update(Text(line, no_wrap=True, overflow="ellipsis"), refresh=True)
