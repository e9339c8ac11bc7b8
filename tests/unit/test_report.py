"""report: facts as a person reads them, and as many of them as a terminal has room for."""

from __future__ import annotations

import json
import logging
from typing import Any

import pytest
import trio

from mavftpfs.cli.report import delivery_line, status_lines
from mavftpfs.client.status import snapshot
from mavftpfs.client.watcher import Watcher
from mavftpfs.shared.readable import printable, readable_size, readable_time

VEHICLE = {
    "system": 1,
    "component": 1,
    "autopilot": "PX4",
    "armed": False,
    "when_armed": "ro",
    "heartbeat_age": 0.4,
    "restarts": 0,
}
LINK = {
    "state": "fine",
    "rtt": 0.04,
    "loss": 0.0,
    "other_ftp_client": False,
    "received_bytes": 9000,
    "sent_bytes": 1000,
}
READ = {"path": "/fs/microsd/log/2026-11-20/10_32_15.ulg", "size": 3_400_000, "done": 1_190_000}
WRITE = {"path": "/a", "size": 4096, "bytes_left": 1024, "sending": True, "eta": 3.4}


def connection(facts: dict[str, Any]) -> dict[str, Any]:
    """Return what a connection tells, with these facts of the vehicle or the link."""
    return {
        "vehicle": {name: facts.get(name, value) for name, value in VEHICLE.items()},
        "link": {name: facts.get(name, value) for name, value in LINK.items()},
    }


def status(
    facts: dict[str, Any] | None = None, cache: dict[str, Any] | None = None, **more: Any
) -> dict[str, Any]:
    """Return a status as a mount gives it."""
    told = snapshot(connection(facts or {}), cache or {}, 5100.0)
    return {"mountpoint": "/mnt/drone", "state": "mounted", "problem": None, **told, **more}


def lines(*args: Any, **more: Any) -> list[str]:
    return status_lines(status(*args, **more))


@pytest.mark.parametrize(
    ("facts", "line"),
    [
        ({}, "PX4 1/1, disarmed, link fine: RTT 40 ms, loss 0 %, 5.1 kB/s"),
        ({"rtt": None, "autopilot": "ArduPilot"}, "ArduPilot 1/1, disarmed, link fine: loss 0 %, 5.1 kB/s"),
        ({"armed": True}, "PX4 1/1, ARMED (read-only), link fine: RTT 40 ms, loss 0 %, 5.1 kB/s"),
        ({"state": "lossy", "loss": 0.2}, "PX4 1/1, disarmed, link lossy: RTT 40 ms, loss 20 %, 5.1 kB/s"),
        ({"state": "lost", "heartbeat_age": 80}, "PX4 1/1, disarmed, LOST: last heard 1 min 20 s ago"),
        ({"state": "replaced"}, "PX4 1/1, disarmed, LOST: another vehicle answers in its place"),
        (
            {"other_ftp_client": True},
            "PX4 1/1, disarmed, link fine: RTT 40 ms, loss 0 %, 5.1 kB/s, another FTP client is heard",
        ),
    ],
)
def test_the_first_line_is_for_a_pilot(facts: dict[str, Any], line: str) -> None:
    assert lines(facts)[0] == f"/mnt/drone: {line}"


def test_what_moves_comes_next_and_then_what_is_held_back() -> None:
    waiting = {"path": "/b", "size": 0, "bytes_left": 0, "sending": False, "eta": 9.0}
    cache = {
        "reads": [READ],
        "rate": 5100.0,
        "transfers": [WRITE, waiting, {**waiting, "path": "/e", "sending": True}],
        "write_rate": 300.0,
        "files_undelivered": 3,
        "bytes_undelivered": 4096,
        "errors": {"/b": "the card is full", "/c": "no"},
    }
    assert lines(None, cache)[1:] == [
        "  reading /fs/microsd/log/2026-11-20/10_32_15.ulg: 35 % of 3.4 MB, 5.1 kB/s, 7 min 13 s left",
        "  sending /a: 75 % of 4.1 kB, 300 B/s, 3.4 s left",
        "  waiting /b: empty, the card is full",
        "  sending /e: empty",
        "  pending: 3 files, 4.1 kB",
        "  failed /c: no",
    ]
    assert lines({"armed": True}, {**cache, "reads": []})[1:5] == [
        "  waiting /a: 75 % of 4.1 kB",
        "  waiting /b: empty, the card is full",
        "  waiting /e: empty",
        "  pending: 3 files, 4.1 kB, until the vehicle is disarmed",
    ]


def test_a_status_of_many_files_fits_an_extended_attribute() -> None:
    names = [f"/fs/microsd/log/2026-11-20/{number:05}.ulg" for number in range(5000)]
    cache = {
        "transfers": [{**WRITE, "path": name, "sending": False} for name in names],
        "files_undelivered": len(names),
        "errors": dict.fromkeys(names, "the vehicle is armed: nothing is written in flight (when_armed=ro)"),
    }
    facts = status(None, cache)
    assert facts["held"]["files"] == 5000
    assert len(facts["transfers"]) == len(facts["held"]["errors"]) == 100
    assert len(json.dumps(facts)) < 50_000


def test_nothing_held_back_is_said_where_it_can_be_written() -> None:
    assert lines()[1:] == ["  nothing is pending: the vehicle has all that was written"]
    assert lines(read_only=True)[1:] == []


def test_a_failed_write_names_the_recovery_directory_of_the_mount(monkeypatch: pytest.MonkeyPatch) -> None:
    """A mount of an earlier version does not send it."""
    monkeypatch.setenv("XDG_STATE_HOME", "/mine")
    cache = {"broken": {"/a": "the link is cut"}}
    (told,) = lines(None, cache, recovered="/theirs/mavftpfs/recovered")[1:]
    assert told.endswith("moves the part that was written to /theirs/mavftpfs/recovered)")
    assert lines(None, cache)[1].endswith(" to /mine/mavftpfs/recovered)")


async def test_what_holds_from_one_heartbeat_to_the_next_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    def facts() -> dict[str, Any]:
        return connection({"armed": 0.05 < trio.current_time() - began < 0.95})

    caplog.set_level(logging.INFO, "mavftpfs")
    began = trio.current_time()
    with trio.move_on_after(3):
        await Watcher(facts, writing=False).run()
    assert caplog.messages == ["vehicle 1/1 is armed", "vehicle 1/1 is disarmed"]


def test_the_traffic_is_told_when_it_was_seen_for_some_seconds() -> None:
    now = 0.0
    watcher = Watcher(lambda: connection({"received_bytes": int(5000 * now)}), writing=False)
    told = []
    for now in (0.0, 1.0, 2.0, 3.2):
        watcher.look(now)
        told.append(watcher.traffic)
    assert told == [None, None, None, 5000.0]


def test_a_delivery_says_what_it_waits_for() -> None:
    cache = {"transfers": [WRITE], "write_rate": 300.0, "files_undelivered": 1, "bytes_undelivered": 4096}
    assert delivery_line(status(None, cache)) == "uploading 1 file, 3.1 kB of 4.1 kB, 300 B/s, 3.4 s left"
    lost = delivery_line(status({"state": "lost"}, {**cache, "transfers": [{**WRITE, "sending": False}]}))
    assert lost == "uploading 1 file, 3.1 kB of 4.1 kB, until the vehicle is back"
    assert delivery_line(status()) == ""


def test_nobody_is_told_of_half_a_second() -> None:
    cache = {"transfers": [{**WRITE, "eta": 0.5}], "write_rate": 300.0, "files_undelivered": 1}
    assert "1.0 s left" in lines(None, cache)[1]
    assert "1.0 s left" in delivery_line(status(None, {**cache, "bytes_undelivered": 1}))


def test_sizes_times_and_names() -> None:
    sizes = [readable_size(n) for n in (0, 999, 999.7, 1000, 999_949, 999_999, 5e9)]
    assert sizes == ["0 B", "999 B", "1.0 kB", "1.0 kB", "999.9 kB", "1.0 MB", "5.0 GB"]
    times = [readable_time(s) for s in (0.0401, 1, 9.97, 59.4, 59.9, 200, 7500)]
    assert times == ["40 ms", "1.0 s", "10 s", "59 s", "1 min", "3 min 20 s", "2 h 5 min"]
    assert printable("a\x1b[31mb") == "a?[31mb"
