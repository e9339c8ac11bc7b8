"""Tables, progress bars and listings for people. Layer: top; with demo and cli the only user of rich.

Names come from the vehicle, so nothing reaches the terminal that could be an escape sequence.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from typing import Any, Protocol

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn
from rich.progress import TransferSpeedColumn as SpeedColumn
from rich.table import Table
from rich.text import Text

from mavftpfs.shared.readable import autopilot_name, printable, readable_size

WATCH_PERIOD = 1.0

_WORDS = {
    "rtt": "round trip",
    "ftp_flag": "says it supports FTP",
    "heartbeat_age": "last heartbeat",
    "lists_times": "listings carry times",
    "other_ftp_client": "another FTP client heard",
    "pid": "process",
    "window": "requests at a time",
    "read_mode": "reading by",
}
_FIRST = ("bytes_held", "files_undelivered", "transfers", "errors")
"""What people look for in `cache`: a small terminal that shows the status again and again cuts its end."""

_DETAILS = {"write_traits", "kernel"}
"""Facts for programs: --json."""

_SECONDS = {"rtt", "heartbeat_age", "uptime", "eta"}


class Meter(Protocol):
    """Is told how a transfer goes."""

    def start(self, name: str, total: int) -> Callable[[int], None]:
        """Begin a file of `total` bytes; returns what to call with the bytes that came."""
        ...


class SilentMeter:
    """For output that is not a terminal."""

    def start(self, name: str, total: int) -> Callable[[int], None]:
        """Begin a file."""
        return lambda count: None


class _BarMeter:
    def __init__(self, progress: Progress) -> None:
        self._progress = progress

    def start(self, name: str, total: int) -> Callable[[int], None]:
        task = self._progress.add_task(printable(name), total=total)
        return lambda count: self._progress.advance(task, count)


@contextmanager
def transfer_meter() -> Iterator[Meter]:
    """Show progress bars on stderr during the body, if it is a terminal."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield SilentMeter()
        return
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        DownloadColumn(),
        SpeedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console) as progress:
        yield _BarMeter(progress)


def print_status(statuses: Sequence[Mapping[str, Any]]) -> None:
    """Print one block for each mount."""
    Console().print(_blocks(statuses))


def watch_status(fetch: Callable[[], Sequence[Mapping[str, Any]]]) -> None:
    """Redraw the status each second until interrupted."""
    with Live(_blocks(fetch()), auto_refresh=False) as live:
        while True:
            time.sleep(WATCH_PERIOD)
            live.update(_blocks(fetch()), refresh=True)


def print_json(fetch: Callable[[], Sequence[Mapping[str, Any]]], *, single: bool, watch: bool) -> None:
    """Print the status as JSON: once to be read, or with `watch` one line each second until interrupted.

    single: the only status is the whole answer, not a list of one.
    """
    while True:
        facts = fetch()
        print(json.dumps(facts[0] if single else facts, indent=None if watch else 2), flush=True)
        if not watch:
            return
        time.sleep(WATCH_PERIOD)


def _blocks(statuses: Sequence[Mapping[str, Any]]) -> RenderableType:
    if not statuses:
        return Text("no vehicle is mounted")
    return Group(*(_block(status) for status in statuses))


def _block(status: Mapping[str, Any]) -> Table:
    title = printable(f"{status.get('source', '?')} on {status.get('mountpoint', '?')}")
    table = Table(title=Text(title), show_header=False, title_justify="left")
    table.add_column(style="bold")
    table.add_column(overflow="fold")
    facts = {key: value for key, value in status.items() if key not in ("source", "mountpoint")}
    for name, value in rows(facts):
        table.add_row(Text(name), Text(value))
    return table


def rows(facts: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Return names and values as a person reads them, what matters most first."""
    cache = facts.get("cache")
    if isinstance(cache, Mapping):
        yield from _rows({key: cache[key] for key in _FIRST if key in cache}, "cache: ")
        facts = {**facts, "cache": {key: value for key, value in cache.items() if key not in _FIRST}}
    yield from _rows(facts)


def _rows(facts: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Flatten nested facts, but for those that say nothing; a group's name goes before the names in it."""
    for key, value in facts.items():
        name = prefix + _WORDS.get(key, key.replace("_", " "))
        if key in _DETAILS or (key not in _SAID and not isinstance(value, bool) and not value):
            continue
        if isinstance(value, Mapping) and value:
            yield from _rows(value, f"{name}: ")
        else:
            yield printable(name), printable(describe(key, value))


def describe(key: str, value: Any) -> str:
    """Return a fact as a person reads it."""
    if value is None:
        return "none" if key == "session_open" else "unknown"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if key in _SECONDS and isinstance(value, int | float):
        return f"{value * 1000:.0f} ms" if value < 1 else f"{value:.1f} s"
    if isinstance(value, int) and ("bytes" in key or key == "dirty_max"):
        return readable_size(value)
    if key.endswith("rate") and isinstance(value, int | float):
        return f"{readable_size(value)}/s"
    if key == "loss":
        return f"{value * 100:.1f} %"
    if key in _WRITTEN and value != []:
        return _WRITTEN[key](value)
    if isinstance(value, list | tuple):
        return ", ".join(map(str, value)) or "none"
    return "none" if value == {} else str(value)


def _transfer(facts: Mapping[str, Any]) -> str:
    """Return how one file gets on."""
    done = facts["size"] - facts["bytes_left"]
    share = f"{max(done, 0) * 100 // facts['size']} %" if facts["size"] else "empty"
    state = "sending" if facts["sending"] else "waiting"
    eta = "" if facts["eta"] is None else f", {facts['eta']:.0f} s left"
    return f"{facts['path']} {state}, {share} of {readable_size(facts['size'])}{eta}"


def _upload(facts: Mapping[str, Any]) -> str:
    """Return how far the bytes of one file went."""
    error = "" if facts["error"] is None else f" ({facts['error']})"
    state = "running" if facts["running"] else "waiting"
    return f"{facts['path']} {state}, {readable_size(facts['reached'])} sent{error}"


_WRITTEN: dict[str, Callable[[Any], str]] = {
    "transfers": lambda value: "; ".join(map(_transfer, value)),
    "uploads": lambda value: "; ".join(map(_upload, value)),
    "autopilot": autopilot_name,
    "vehicle": lambda value: "system {}, component {}".format(*value),
}
"""Facts that are no sentence by themselves."""

_SAID = {*_FIRST, *_WRITTEN} - {"uploads"}
"""Facts that are told even if they are none."""


def print_listings(
    listings: Sequence[tuple[str | None, Sequence[Mapping[str, Any]]]], *, detailed: bool
) -> None:
    """Print several paths as ls does: files (no directory) first, then directories with headings."""
    files = [entry for directory, entries in listings if directory is None for entry in entries]
    print_names(files, detailed=detailed)
    apart = bool(files)
    for directory, entries in listings:
        if directory is None:
            continue
        if len(listings) > 1:
            _print_line("\n" * apart + _shown(directory) + ":")
        print_names(entries, detailed=detailed)
        apart = True


def print_names(entries: Sequence[Mapping[str, Any]], *, detailed: bool) -> None:
    """Print a listing: one name a line, directories with a slash; detailed with size and time."""
    for entry in entries:
        name = _shown(entry["name"]) + ("/" if entry["kind"] == "directory" else "")
        if detailed:
            when = datetime.fromtimestamp(entry["mtime"], UTC).strftime("%Y-%m-%d %H:%M")
            name = f"{entry['size']:>12} {when} {name}"
        _print_line(name)
    sys.stdout.flush()


def _shown(name: str) -> str:
    """Return a name as the terminal may get it; in a pipe it is the name."""
    return printable(name) if sys.stdout.isatty() else name


def _print_line(line: str) -> None:
    sys.stdout.buffer.write(line.encode("utf-8", "surrogateescape") + b"\n")


def print_scan(found: Sequence[Mapping[str, Any]]) -> None:
    """Print who answered on a link."""
    table = Table()
    for heading in ("system/component", "what it is", "FTP"):
        table.add_column(heading)
    for peer in found:
        table.add_row(f"{peer['system']}/{peer['component']}", Text(peer["what"]), Text(peer["ftp"]))
    Console().print(table)
