"""What mounts tell of themselves: the facts, how they are asked for, and the lines people read. Layer: top.

A mount builds its status from two plain dictionaries, `Connection.status()` and `Tree.status()`; the keys
are those of `status --json`, which docs/guide.md describes. It is asked over its control socket. Where that
cannot be reached (it is another user's) the extended attribute of its root says the same to whoever may read
the mount; root may ask everybody's. Of a mount that cannot be asked only `mountpoint`, `source`, `state` and
`problem` are known. Names come from the vehicle, so nothing reaches the terminal that could be an escape
sequence.
"""

from __future__ import annotations

import errno
import json
import logging
import os
import shutil
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import trio

from mavftpfs import control
from mavftpfs.control import ControlError, NobodyThere
from mavftpfs.fuse.handles import XATTR_STATUS
from mavftpfs.mountpoint import OUR_TYPE, Mounted, mounts
from mavftpfs.shared.readable import printable, readable_size, readable_time

log = logging.getLogger("mavftpfs.vehicle")

Facts = Mapping[str, Any]

PERIOD = 0.25
"""Seconds between two looks at the connection: a heartbeat holds until the next, about a second."""
RATE_SPAN = 20
"""Looks over which the traffic on the link is averaged."""
MOST = 100
"""Entries of each list: an extended attribute holds 64 KiB. `held` counts them all."""
_TOLD = {"transfers", "errors", "reads"}
"""What the cache tells that stands in the snapshot's own lists."""


def snapshot(connection: Facts, cache: Facts, traffic: float | None) -> dict[str, Any]:
    """Return the facts of a status, JSON-able; bytes, seconds, and bytes per second; None = unknown."""
    vehicle, link = connection["vehicle"], connection["link"]
    moving = link["state"] in ("fine", "lossy")
    return {
        **connection,
        "link": {**link, "rate": traffic},
        "transfers": _transfers(cache, moving=moving, writing=moving and not _read_only(vehicle)),
        "held": {
            "files": cache.get("files_undelivered", 0),
            "bytes": cache.get("bytes_undelivered", 0),
            "bytes_on_disk": cache.get("bytes_held_on_disk", 0),
            "errors": dict(islice(cache.get("errors", {}).items(), MOST)),
        },
        "cache": {key: value for key, value in cache.items() if key not in _TOLD},
    }


def _read_only(vehicle: Facts) -> bool:
    """Return whether nothing is written to a vehicle, because it is armed."""
    return bool(vehicle["armed"]) and vehicle["when_armed"] == "ro"


def _transfers(cache: Facts, *, moving: bool, writing: bool) -> list[dict[str, Any]]:
    """Return what is being read or written, what is sent before what waits.

    moving: the vehicle is there; writing: and it may be written to.
    """
    found = []
    for read in cache.get("reads", []):
        left, rate = read["size"] - read["done"], cache.get("rate") if moving else None
        eta = round(left / rate, 1) if rate else None
        found.append({"direction": "read", "state": "reading", **read, "rate": rate, "eta": eta})
    for write in cache.get("transfers", []):
        sending = write["sending"] and writing
        found.append(
            {
                "direction": "write",
                "state": "sending" if sending else "waiting",
                "path": write["path"],
                "size": write["size"],
                "done": max(0, write["size"] - write["bytes_left"]),
                "rate": cache.get("write_rate") if sending else None,
                "eta": write["eta"] if writing else None,
                "error": cache.get("errors", {}).get(write["path"]),
            }
        )
    return found[:MOST]


class Watcher:
    """Looks at a connection: logs each change that a pilot cares for, measures the traffic."""

    def __init__(self, status: Callable[[], Facts], *, writing: bool) -> None:
        """`status`: Connection.status; `writing`: the mount is not a read-only one."""
        self._status = status
        self._writing = writing
        self._seen: tuple[str, int, bool, bool] | None = None
        self._silent_since: float | None = None
        self._bytes: deque[tuple[float, int]] = deque(maxlen=RATE_SPAN + 1)

    @property
    def traffic(self) -> float | None:
        """Bytes per second, both ways, over the last few seconds; None while too little was seen."""
        if len(self._bytes) < 2:
            return None
        (began, first), (ended, last) = self._bytes[0], self._bytes[-1]
        return round((last - first) / (ended - began), 1) if ended > began else None

    async def run(self) -> None:
        """Look until cancelled."""
        while True:
            self.look(trio.current_time())
            await trio.sleep(PERIOD)

    def look(self, now: float) -> None:
        """Look once."""
        facts = self._status()
        vehicle, link = facts["vehicle"], facts["link"]
        self._bytes.append((now, link["received_bytes"] + link["sent_bytes"]))
        before = self._seen
        self._seen = link["state"], vehicle["restarts"], bool(vehicle["armed"]), link["other_ftp_client"]
        if before is None:
            return
        state, restarts, armed, rival = before
        name = f"vehicle {vehicle['system']}/{vehicle['component']}"
        if state != link["state"]:
            self._log_state(name, state, link["state"], vehicle["heartbeat_age"] or 0.0, now)
        if restarts < vehicle["restarts"]:
            log.warning("%s restarted", name)
        if armed and not vehicle["armed"]:
            log.info("%s is disarmed", name)
        if vehicle["armed"] and not armed:
            waits = self._writing and _read_only(vehicle)
            log.info("%s is armed%s", name, ": nothing is written to it until it is disarmed" * waits)
        if rival is not link["other_ftp_client"]:
            log.info("another FTP client of %s is heard%s", name, " no more" * rival)

    def _log_state(self, name: str, before: str, state: str, silence: float, now: float) -> None:
        if state == "lost":
            self._silent_since = now - silence
            log.warning("%s is lost: no heartbeat for %s", name, readable_time(silence))
        elif before == "lost" and state != "replaced":
            away = "" if self._silent_since is None else f" after {readable_time(now - self._silent_since)}"
            log.info("%s is back%s", name, away)
        elif before == "replaced":
            log.info("%s is the one again that was mounted", name)


Status = Mapping[str, Any]

PATIENCE = 10.0
"""Seconds for a mount to answer: it does so without asking the vehicle."""


# -- asking mounts ----------------------------------------------------------------------------------


def all_statuses() -> list[Status]:
    """Return the status of each mount that this user may ask, the dead ones too, by mountpoint."""
    found: dict[str, Status] = {}
    for path, mount in mounts().items():
        status = _status_of(path, mount) if mount.type == OUR_TYPE else None
        if status is not None:
            found[path] = status
    known = {control.socket_name(path) for path in found}
    for socket in control.all_sockets(control.own_directories()):
        if socket.name not in known:
            # The kernel shows it no more, but it still delivers; or it is in another mount namespace.
            status = _ask_or_remove(socket)
            if status is not None:
                found.setdefault(status["mountpoint"], status)
    return [found[path] for path in sorted(found)]


def status_of(mountpoint: str) -> Status:
    """Return the status of one mount; if it cannot be asked `state` (dead, mute) and `problem` in words.

    Raises:
        NobodyThere: no vehicle is mounted there, or this user may not ask.
    """
    mount = mounts().get(mountpoint)
    if mount is not None and mount.type == OUR_TYPE:
        status = _status_of(mountpoint, mount)
        if status is not None:
            return status
    return _ask(control.find_socket(mountpoint, control.own_directories()))


def find_socket(mountpoint: str) -> Path:
    """Return the control socket of a mount; root finds other users', too.

    Raises:
        NobodyThere: there is none.
    """
    mount = mounts().get(mountpoint)
    directories = control.own_directories()
    if mount is not None and mount.uid not in (None, os.getuid()):
        directories += control.directories_of(mount.uid)
    return control.find_socket(mountpoint, directories)


def _status_of(path: str, mount: Mounted) -> Status | None:
    """Return what a mount says; None if this user may not ask."""
    try:
        return _ask(find_socket(path))
    except NobodyThere:
        pass
    except ControlError as exc:
        return _unasked(path, mount, "mute", f"its program does not answer: {exc}")
    answer = _read_xattr(path)
    if isinstance(answer, bytes):
        facts: Status = json.loads(answer)
        return facts
    if answer == errno.ENOTCONN:
        return _unasked(path, mount, "dead", f"DEAD: its program is gone; run: mavftpfs umount {path}")
    if answer in (errno.EACCES, errno.EPERM):
        return None
    return _unasked(path, mount, "mute", f"its program does not answer: {os.strerror(answer)}")


def _unasked(path: str, mount: Mounted, state: str, problem: str) -> Status:
    return {"mountpoint": path, "source": mount.source, "state": state, "problem": problem}


def _read_xattr(path: str) -> bytes | int:
    """Return the attribute, or the errno; from a thread, because a program that was stopped answers never."""
    answer: list[bytes | int] = []

    def read() -> None:
        try:
            answer.append(os.getxattr(path, XATTR_STATUS))
        except OSError as exc:
            answer.append(exc.errno or errno.EIO)

    thread = threading.Thread(target=read, daemon=True)
    thread.start()
    thread.join(PATIENCE)
    return answer[0] if answer else errno.ETIMEDOUT


def _ask(socket: Path) -> Status:
    facts: Status = control.ask(socket, {"command": "status"}, timeout=PATIENCE)["status"]
    return facts


def _ask_or_remove(socket: Path) -> Status | None:
    try:
        return _ask(socket)
    except NobodyThere:
        socket.unlink(missing_ok=True)
    except ControlError:
        pass  # which mount it is, only it could say
    return None


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
    lines = [first, *map(_transfer_line, status["transfers"]), *_held_lines(status)]
    rest = {key: value for key, value in status.items() if key not in _IN_THE_LINES}
    return [*lines, *_rows(rest, "  ")] if verbose else lines


def _rows(facts: Mapping[str, Any], before: str) -> Iterator[Line]:
    """Yield nested facts as `--json` has them, a line each, but for those that say nothing."""
    for key, value in facts.items():
        name = before + key.replace("_", " ")
        if isinstance(value, Mapping):
            yield from _rows(value, f"{name}: ")
        elif value not in (None, "", [], ()):
            yield Line(f"{name}: {value}")


def _headline(status: Status) -> str:
    if status.get("problem"):
        return str(status["problem"])
    vehicle = status["vehicle"]
    name = f"{vehicle['autopilot'] or 'vehicle'} {vehicle['system']}/{vehicle['component']}"
    leaving = "being unmounted, " if status.get("state") == "unmounting" else ""
    return f"{leaving}{name}, {_armed_words(vehicle)}, {_link_words(status)}"


def _armed_words(vehicle: Status) -> str:
    if not vehicle["armed"]:
        return "disarmed"
    return "ARMED (read-only)" if _read_only(vehicle) else "ARMED"


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
    if transfer["rate"]:
        facts.append(f"{readable_size(transfer['rate'])}/s")
    if transfer["eta"] is not None and transfer["state"] != "waiting":
        facts.append(f"{readable_time(transfer['eta'])} left")
    if transfer.get("error"):
        facts.append(transfer["error"])
    return Line(f"  {transfer['state']} ", transfer["path"], ": " + ", ".join(facts))


def _held_lines(status: Status) -> Iterator[Line]:
    held, files = status["held"], status["held"]["files"]
    if not files:
        if not status.get("read_only"):
            yield Line("  nothing is held back: all that was written is on the vehicle")
        return
    yield Line(f"  held back: {count_files(files)}, {readable_size(held['bytes'])}{_waits_for(status)}")
    shown = {transfer["path"] for transfer in status["transfers"]}
    for path, error in held["errors"].items():
        if path not in shown:
            yield Line("  failed ", path, f": {error}")


def _waits_for(status: Status) -> str:
    if status["link"]["state"] in ("lost", "replaced"):
        return ", until the vehicle is back"
    if _read_only(status["vehicle"]):
        return ", until the vehicle is disarmed"
    return ""


def count_files(count: int) -> str:
    """Return `1 file`, `2 files`."""
    return f"{count} file" if count == 1 else f"{count} files"


def delivery_line(status: Status) -> str:
    """Return what a mount that is being unmounted waits for, in a line; "" if for nothing."""
    held = status["held"]
    if not held["files"]:
        return ""
    sending = [transfer for transfer in status["transfers"] if transfer["state"] == "sending"]
    eta = max((t["eta"] for t in status["transfers"] if t["eta"] is not None), default=None)
    rate = f", {readable_size(sending[0]['rate'])}/s" if sending and sending[0]["rate"] else ""
    left = "" if eta is None or not sending else f", {readable_time(eta)} left"
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
    """Return lines that fit a terminal: the first of each mount, and of its others what there is room for."""
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
    """Return what draws the lines from the top of a terminal, the first line of each mount in bold.

    All is erased before: behind a line as wide as the terminal an erasure takes its last character.
    """
    shown = (line if line.startswith(" ") else f"\x1b[1m{line}\x1b[m" for line in lines)
    return "\x1b[H\x1b[J" + "\n".join(shown)


def watch_status(fetch: Callable[[], Sequence[Status]], *, verbose: bool) -> None:
    """Show the status again each second until interrupted; on a terminal in place, on a screen of its own."""
    if not sys.stdout.isatty():
        while True:
            print_status(fetch(), verbose=verbose)
            print()
            time.sleep(WATCH_PERIOD)
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
        sys.stdout.flush()


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
