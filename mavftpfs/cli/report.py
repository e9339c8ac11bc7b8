"""The lines that people read of mounts. Layer: cli.

Names come from the vehicle, so nothing reaches the terminal that could be an escape sequence.
"""

from __future__ import annotations

import json
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from mavftpfs.client.status import Status, is_read_only, second_vehicle
from mavftpfs.shared.readable import count_files, printable, readable_size, readable_time

WATCH_PERIOD = 1.0
NOTHING = "no vehicle is mounted"

_IN_THE_LINES = {"mountpoint", "problem", "transfers"}
_SHORTEST_PATH = 12
"""Characters that are left of a path where a line is too narrow for all of it."""


class Line(NamedTuple):
    """A line with a path in it, of which the end matters most where there is too little room."""

    before: str
    path: str = ""
    after: str = ""

    def fitted(self, width: int | None = None) -> str:
        """Return the line; with a width, cut to it."""
        path = printable(self.path)
        if width is None:
            return printable(self.before) + path + printable(self.after)
        room = max(_SHORTEST_PATH, width - len(self.before) - len(self.after))
        if len(path) > room:
            path = "…" + path[len(path) - room + 1 :]
        line = printable(self.before) + path + printable(self.after)
        return line if len(line) <= width else line[: width - 1] + "…"


# -- what is said -----------------------------------------------------------------------------------


def status_lines(status: Status, *, verbose: bool = False) -> list[Line]:
    """Return a mount's lines: one for a pilot, what moves, what is held back; verbose: the rest, too."""
    first = Line("", str(status.get("mountpoint", "?")), f": {_headline(status)}")
    if status.get("problem"):
        return [first]
    if "members" in status:
        return [first, *_member_lines(status)]
    second = [Line(f"  {second_vehicle(status)}")] if status["link"].get("second") else []
    lines = [first, *second, *map(_transfer_line, status["transfers"]), *_held_lines(status)]
    rest = {key: value for key, value in status.items() if key not in _IN_THE_LINES}
    return [*lines, *_rows(rest, "  ")] if verbose else lines


def _member_lines(status: Status) -> Iterator[Line]:
    """Yield a line for each vehicle whose own mount is not up."""
    for member in status["members"]:
        if member["state"] != "mounted":
            yield Line(f"  vehicle {member['name']}: {member['problem'] or member['state']}")


def _rows(facts: Mapping[str, Any], before: str) -> Iterator[Line]:
    """Yield nested facts as `--json` has them, a line for each that says something."""
    for key, value in facts.items():
        name = before + key.replace("_", " ")
        if isinstance(value, Mapping):
            yield from _rows(value, f"{name}: ")
        elif value not in (None, "", [], ()):
            yield Line(f"{name}: {_fact(value)}")


def _fact(value: object) -> str:
    """Return a value as people write it: yes and no, and only the digits that matter."""
    match value:
        case bool():
            return "yes" if value else "no"
        case float():
            return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"
    return str(value)


def _headline(status: Status) -> str:
    if status.get("problem"):
        return str(status["problem"])
    leaving = "being unmounted, " if status.get("state") == "unmounting" else ""
    if "members" in status:
        count = len(status["members"])
        return f"{leaving}{count} {'vehicle' if count == 1 else 'vehicles'} of {status['source']}"
    vehicle = status["vehicle"]
    name = f"{vehicle['autopilot'] or 'vehicle'} {vehicle['system']}/{vehicle['component']}"
    return f"{leaving}{name}, {_armed_words(vehicle)}, {_link_words(status)}"


def _armed_words(vehicle: Status) -> str:
    if not vehicle["armed"]:
        return "disarmed"
    return "ARMED (read-only)" if is_read_only(vehicle) else "ARMED"


def _link_words(status: Status) -> str:
    link, age = status["link"], status["vehicle"]["heartbeat_age"]
    if link["state"] == "replaced":
        return "LOST: another vehicle answers in its place"
    if link["state"] == "lost":
        return "LOST" if age is None else f"LOST: last heard {readable_time(age)} ago"
    facts = []
    if link["rtt"] is not None:
        facts.append(f"RTT {readable_time(link['rtt'])}")
    if link["loss"] is not None:
        facts.append(f"loss {_percent(link['loss'])}")
    if link["rate"] is not None:
        facts.append(f"{readable_size(link['rate'])}/s")
    others = ", another FTP client is heard" if link["other_ftp_client"] else ""
    return f"link {link['state']}" + (": " + ", ".join(facts) if facts else "") + others


def _percent(share: float) -> str:
    return "<1 %" if 0 < share < 0.005 else f"{share * 100:.0f} %"


def _transfer_line(transfer: Status) -> Line:
    size, done = transfer["size"], transfer["done"]
    facts = [f"{done * 100 // size} % of {readable_size(size)}" if size else "empty"]
    if size and transfer["rate"]:
        facts.append(f"{readable_size(transfer['rate'])}/s")
    if size and transfer["eta"] is not None and transfer["state"] != "waiting":
        facts.append(time_left(transfer["eta"]))
    if transfer.get("error"):
        facts.append(transfer["error"])
    return Line(f"  {transfer['state']} ", transfer["path"], ": " + ", ".join(facts))


def _held_lines(status: Status) -> Iterator[Line]:
    held, files = status["held"], status["held"]["files"]
    for path, error in held.get("broken", {}).items():
        yield Line("  write failed ", path, f": {error}; copy the file again ({_part_goes()})")
    if not files:
        if not (status.get("read_only") or held.get("broken")):
            yield Line("  nothing is held back: all that was written is on the vehicle")
        return
    yield Line(f"  held back: {count_files(files)}, {readable_size(held['bytes'])}{_waits_for(status)}")
    shown = {transfer["path"] for transfer in status["transfers"]}
    for path, error in held["errors"].items():
        if path not in shown:
            yield Line("  failed ", path, f": {error}")


def _part_goes() -> str:
    """Return where the part of a file goes of which a write failed."""
    from mavftpfs.client.leftovers import recovered_directory

    return f"umount moves the part that was written to {recovered_directory()}"


def _waits_for(status: Status) -> str:
    if status["link"]["state"] in ("lost", "replaced"):
        return ", until the vehicle is back"
    if is_read_only(status["vehicle"]):
        return ", until the vehicle is disarmed"
    return ""


def time_left(seconds: float) -> str:
    """Return how much longer it takes, at least a second."""
    return f"{readable_time(max(1.0, seconds))} left"


def delivery_line(status: Status) -> str:
    """Return a line on what a mount that is being unmounted waits for; "" for nothing."""
    held = status.get("held")
    if held is None or not held["files"]:
        return ""
    sending = [transfer for transfer in status["transfers"] if transfer["state"] == "sending"]
    eta = max((t["eta"] for t in status["transfers"] if t["eta"] is not None), default=None)
    rate = f", {readable_size(sending[0]['rate'])}/s" if sending and sending[0]["rate"] else ""
    left = "" if eta is None or not sending else f", {time_left(eta)}"
    done, size = (sum(t[key] for t in status["transfers"]) for key in ("done", "size"))
    amount = f"{readable_size(done)} of {readable_size(size)}"
    return f"delivering {count_files(held['files'])}, {amount}{rate}{left}{_waits_for(status)}"


# -- showing ----------------------------------------------------------------------------------------


def print_status(statuses: Sequence[Status], *, verbose: bool) -> None:
    """Print each mount's lines; the same to a terminal and to a pipe."""
    for status in statuses:
        for line in status_lines(status, verbose=verbose):
            print(line.fitted())
    if not statuses:
        print(NOTHING)
    sys.stdout.flush()


def panel(statuses: Sequence[Status], width: int, height: int, *, verbose: bool = False) -> list[str]:
    """Return lines that fit a terminal: the first of each mount, and as many others as there is room for."""
    if not statuses:
        return [NOTHING]
    blocks = [status_lines(status, verbose=verbose) for status in statuses]
    shown: list[str] = []
    for number, block in enumerate(blocks):
        room = max(1, (height - len(shown)) // (len(blocks) - number))
        shown += [line.fitted(width) for line in _cut(block, room)]
    if len(shown) > height:
        more = f"… and {len(shown) - height + 1} more mounts"
        shown = [*shown[: height - 1], more]
    return shown


def _cut(block: list[Line], room: int) -> list[Line]:
    if len(block) <= room or room < 2:
        return block[:room]
    return [*block[: room - 1], Line(f"  … and {len(block) - room + 1} more lines")]


def screen(lines: Sequence[str]) -> str:
    """Return the text that draws the lines from the top of a terminal, the first line of each mount in bold.

    Everything is erased first: an erasure behind a line as wide as the terminal removes its last character.
    """
    shown = (line if line.startswith(" ") else f"\x1b[1m{line}\x1b[m" for line in lines)
    return "\x1b[H\x1b[J" + "\n".join(shown)


def watch_status(fetch: Callable[[], Sequence[Status]], *, verbose: bool) -> None:
    """Show the status again each second until interrupted; on a terminal in place, on a screen of its own.

    The last picture stays.
    """
    if not sys.stdout.isatty():
        while True:
            print_status(fetch(), verbose=verbose)
            print()
            time.sleep(WATCH_PERIOD)
    lines: Sequence[str] = ()
    sys.stdout.write("\x1b[?1049h\x1b[?25l\x1b[?7l")  # the alternate screen, no cursor, no wrapping
    try:
        while True:
            statuses = fetch()
            size = shutil.get_terminal_size()
            lines = panel(statuses, size.columns, size.lines, verbose=verbose)
            sys.stdout.write(screen(lines))
            sys.stdout.flush()
            time.sleep(WATCH_PERIOD)
    finally:
        sys.stdout.write("\x1b[?7h\x1b[?25h\x1b[?1049l")
        print(*lines, sep="\n", flush=True)


def print_json(fetch: Callable[[], Sequence[Status]], *, single: bool, watch: bool) -> None:
    """Print the status as JSON: once to be read, or with `watch` one line each second until interrupted.

    single: the only status is the whole answer, not a list of one.
    """
    while True:
        facts = fetch()
        print(json.dumps(facts[0] if single else facts, indent=None if watch else 2), flush=True)
        if not watch:
            return
        time.sleep(WATCH_PERIOD)
