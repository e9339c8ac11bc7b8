"""The lines about mounts, for people. Layer: cli.

Names come from the vehicle, so these functions remove everything that could be an escape sequence.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence

from mavftpfs.client.mounts import Status
from mavftpfs.client.status import is_read_only, second_vehicle
from mavftpfs.shared.readable import count_files, printable, readable_size, readable_time, time_left

WATCH_PERIOD = 1.0
NOTHING = "no vehicle is mounted"


# -- what is said -----------------------------------------------------------------------------------


def status_lines(status: Status) -> list[str]:
    """Return a mount's lines: one for a pilot, transfers, pending changes."""
    lines = [f"{status.get('mountpoint', '?')}: {_headline(status)}"]
    if not status.get("problem"):
        lines += _member_lines(status) if "members" in status else _vehicle_lines(status)
    return list(map(printable, lines))


def _vehicle_lines(status: Status) -> Iterator[str]:
    if status["link"].get("second"):
        yield f"  {second_vehicle(status)}"
    yield from map(_transfer_line, status["transfers"])
    yield from _held_lines(status)


def _member_lines(status: Status) -> Iterator[str]:
    """Yield a line for each vehicle whose own mount is down."""
    for member in status["members"]:
        if member["state"] != "mounted":
            yield f"  vehicle {member['name']}: {member['problem'] or member['state']}"


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


def _transfer_line(transfer: Status) -> str:
    size, done = transfer["size"], transfer["done"]
    facts = [f"{done * 100 // size} % of {readable_size(size)}" if size else "empty"]
    if size and transfer["rate"]:
        facts.append(f"{readable_size(transfer['rate'])}/s")
    if size and transfer["eta"] is not None and transfer["state"] != "waiting":
        facts.append(time_left(transfer["eta"]))
    if transfer.get("error"):
        facts.append(transfer["error"])
    return f"  {transfer['state']} {transfer['path']}: {', '.join(facts)}"


def _held_lines(status: Status) -> Iterator[str]:
    held, files = status["held"], status["held"]["files"]
    for path, error in held.get("broken", {}).items():
        yield f"  write failed {path}: {error}; copy the file again ({_part_goes(status)})"
    if not files:
        if not (status.get("read_only") or held.get("broken") or status.get("state") == "unmounting"):
            yield "  nothing is pending: the vehicle has all that was written"
        return
    yield f"  pending: {count_files(files)}, {readable_size(held['bytes'])}{_waits_for(status)}"
    shown = {transfer["path"] for transfer in status["transfers"]}
    for path, error in held["errors"].items():
        if path not in shown:
            yield f"  failed {path}: {error}"


def _part_goes(status: Status) -> str:
    """Return the words about the part of a file whose write failed."""
    return f"umount moves the part that was written to {recovered_in_mount(status)}"


def recovered_in_mount(status: Status) -> str:
    """Return a mount's recovery directory. A mount of an earlier version does not send its own: then this
    user's."""
    from mavftpfs.client.undelivered import recovered_directory

    return str(status.get("recovered") or recovered_directory())


def _waits_for(status: Status) -> str:
    if status["link"]["state"] in ("lost", "replaced"):
        return ", until the vehicle is back"
    if is_read_only(status["vehicle"]):
        return ", until the vehicle is disarmed"
    return ""


def delivery_line(status: Status) -> str:
    """Return a line about the uploads of a mount that is being unmounted; "" without uploads."""
    held = status.get("held")
    if held is None or not held["files"]:
        return ""
    sending = [transfer for transfer in status["transfers"] if transfer["state"] == "sending"]
    eta = max((t["eta"] for t in status["transfers"] if t["eta"] is not None), default=None)
    rate = f", {readable_size(sending[0]['rate'])}/s" if sending and sending[0]["rate"] else ""
    left = "" if eta is None or not sending else f", {time_left(eta)}"
    done, size = (sum(t[key] for t in status["transfers"]) for key in ("done", "size"))
    amount = f"{readable_size(done)} of {readable_size(size)}"
    return f"uploading {count_files(held['files'])}, {amount}{rate}{left}{_waits_for(status)}"


# -- printing ---------------------------------------------------------------------------------------


def all_lines(statuses: Sequence[Status]) -> list[str]:
    """Return the lines of all mounts."""
    return [line for status in statuses for line in status_lines(status)] or [NOTHING]


def watch_status(fetch: Callable[[], Sequence[Status]]) -> None:
    """Show the status again each second until interrupted; on a terminal in place of the last one."""
    if sys.stdout.isatty():
        from mavftpfs.cli import drawing

        drawing.watch(lambda: all_lines(fetch()), WATCH_PERIOD)
    while True:
        print(*all_lines(fetch()), "", sep="\n", flush=True)
        time.sleep(WATCH_PERIOD)


def print_json(fetch: Callable[[], Sequence[Status]], *, single: bool, watch: bool) -> None:
    """Print the status as JSON: once, indented, or with `watch` one line each second until interrupted.

    single: print the only status itself, not a list of one.
    """
    while True:
        facts = fetch()
        print(json.dumps(facts[0] if single else facts, indent=None if watch else 2), flush=True)
        if not watch:
            return
        time.sleep(WATCH_PERIOD)
