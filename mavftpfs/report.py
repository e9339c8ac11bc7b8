"""Tables of facts for people. Layer: top; uses rich.

Names come from the vehicle, so nothing reaches the terminal that could be an escape sequence.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from rich.console import Console, Group, RenderableType
from rich.live import Live
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
