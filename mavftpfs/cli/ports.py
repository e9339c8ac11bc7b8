"""`mavftpfs hub`: the programs that share ports, shown and stopped; and the hub itself. Layer: cli."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Iterator, Mapping
from contextlib import suppress
from typing import Any

from mavftpfs.client.status import said_of_double
from mavftpfs.link.hublink import PROTOCOL, Facts, pack_facts, unpack_facts
from mavftpfs.link.ports import connect, names_in_use, port_name
from mavftpfs.link.uri import parse_source
from mavftpfs.mount import daemon
from mavftpfs.shared.errors import ExitCode, UsageError
from mavftpfs.shared.private import own_directories
from mavftpfs.shared.readable import printable, readable_time

PATIENCE = 5.0
NOTHING = "no port is shared"

Status = Mapping[str, Any]


def hub(args: argparse.Namespace) -> int:
    """Show the hubs, or stop them; with --serve be one."""
    if args.serve:
        return daemon.in_background(lambda report: _serve(args, report))
    if args.stop:
        return _stop(args)
    found = statuses(args.source)
    for facts in found:
        for line in status_lines(facts):
            print(printable(line))
    if not found:
        print(NOTHING)
    return ExitCode.OK


def statuses(source: str | None) -> list[Status]:
    """Return the status of each hub; only that of SOURCE, if it is given."""
    return [facts for _, facts in _hubs(source, {"status": True})]


def _serve(args: argparse.Namespace, report: daemon.Report) -> int:
    from mavftpfs.hub.process import serve

    daemon.log_in_background(own_directories()[-1] / "mavftpfs.log", logging.INFO)
    report(ExitCode.OK, "")
    serve(args.source)
    return ExitCode.OK


def _stop(args: argparse.Namespace) -> int:
    """Stop hubs, after saying what that cuts off."""
    found = list(_hubs(args.source, {"status": True}))
    cut = [facts for _, facts in found if facts["clients"] or _live(facts)]
    for facts in cut:
        for line in status_lines(facts):
            print(printable(line))
    if cut and not args.force:
        raise UsageError("that would be cut (mounts open the port again); --force does it")
    for name, _ in found:
        _ask(name, {"stop": True})
    if not found:
        print(NOTHING)
    return ExitCode.OK


def _live(facts: Status) -> list[Status]:
    """Return the endpoints that are heard."""
    return [
        known for known in facts["endpoints"] if known["heard_ago"] is not None and known["heard_ago"] < 10
    ]


def status_lines(facts: Status) -> Iterator[str]:
    """Yield the lines of one hub."""
    armed = facts["armed"]
    flying = f", ARMED: {', '.join(map(str, armed))}" if armed else ""
    count = len(facts["clients"])
    shared = f"shared by {count}" if count else "kept for a ground station"
    yield f"{facts['source']}: {shared}{flying}"
    for client in facts["clients"]:
        system, component = client["address"]
        yield f"  {client['name'] or 'a program'} as {system}/{component}"
    for endpoint in facts["endpoints"]:
        ago = endpoint["heard_ago"]
        heard = "not heard" if ago is None else f"heard {readable_time(ago)} ago"
        yield f"  forward {endpoint['endpoint']}: {endpoint['problem'] or heard}"
    for double in facts["doubles"]:
        yield f"  {said_of_double(double['system'], double['address'])}"


def _hubs(source: str | None, request: Facts) -> Iterator[tuple[str, Status]]:
    """Yield the name of each port that a hub has, and what the hub replies; that of one SOURCE, or all."""
    for name in names_in_use() if source is None else [port_name(parse_source(source))]:
        reply = _ask(name, request)
        if reply is not None:
            yield name, reply


def _ask(name: str, request: Facts) -> Status | None:
    """Return the reply of the hub that has a port; None if there is none, but perhaps a program alone.

    Raises:
        UsageError: the hub refuses that.
    """
    with suppress(OSError), connect(name) as sock:
        sock.settimeout(PATIENCE)
        sock.send(pack_facts({"protocol": PROTOCOL, **request}))
        reply = unpack_facts(sock.recv(1 << 16))
        if reply is not None and "refused" in reply:
            raise UsageError(reply["refused"])
        return reply
    return None
