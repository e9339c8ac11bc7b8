"""`mavftpfs hub`: the programs that share ports, shown and stopped; and the hub itself. Layer: cli."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Iterator, Mapping
from contextlib import suppress
from typing import Any

from mavftpfs.cli.commands import say
from mavftpfs.client.status import said_of_double
from mavftpfs.link.hublink import PROTOCOL, Facts, pack_facts, unpack_facts
from mavftpfs.link.ports import connect, names_in_use, port_name
from mavftpfs.link.uri import parse_source
from mavftpfs.mount import daemon
from mavftpfs.shared.errors import ExitCode, UsageError
from mavftpfs.shared.private import log_file
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
    """Return the status of each hub; with SOURCE only of that one."""
    replies = [_ask(name, {"status": True}) for name in _names(source)]
    return [facts for facts in replies if facts is not None]


def _serve(args: argparse.Namespace, report: daemon.Report) -> int:
    from mavftpfs.hub.process import serve

    daemon.log_in_background(log_file(), logging.INFO)
    report(ExitCode.OK, "")
    serve(args.source)
    return ExitCode.OK


def _stop(args: argparse.Namespace) -> int:
    """Stop hubs, after printing what that cuts off; skip those of other users, and print their names.

    Raises:
        UsageError: stopping would cut programs off, or all hubs are those of other users.
    """
    found, refused = _ours(args.source)
    if refused and not found:
        raise refused[0]
    for error in refused:
        say(str(error))
    cut = [facts for _, facts in found if facts["clients"] or _live(facts)]
    for facts in cut:
        for line in status_lines(facts):
            print(printable(line))
    if cut and not args.force:
        raise UsageError("stopping would cut these off (mounts open the port again); to stop anyway: --force")
    for name, _ in found:
        _ask(name, {"stop": True})
    if not found:
        print(NOTHING)
    return ExitCode.OK


def _ours(source: str | None) -> tuple[list[tuple[str, Status]], list[UsageError]]:
    """Return the hubs that this user may stop, and the refusals of the others."""
    found, refused = [], []
    for name in _names(source):
        try:
            reply = _ask(name, {"status": True, "may_stop": True})
        except UsageError as exc:
            refused.append(exc)
        else:
            found += [(name, reply)] if reply is not None else []
    return found, refused


def _live(facts: Status) -> list[Status]:
    """Return the endpoints that were heard."""
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
        yield f"  forward {endpoint['endpoint']}: {heard}"
    for double in facts["doubles"]:
        yield f"  {said_of_double(double['system'], double['address'])}"


def _names(source: str | None) -> list[str]:
    """Return the port name of one SOURCE, or the names of all ports that this user's programs have."""
    return names_in_use() if source is None else [port_name(parse_source(source))]


def _ask(name: str, request: Facts) -> Status | None:
    """Return the reply of the hub that has a port; None without a hub, though one program may have the port.

    Raises:
        UsageError: the hub refuses the request.
    """
    with suppress(OSError), connect(name) as sock:
        sock.settimeout(PATIENCE)
        sock.send(pack_facts({"protocol": PROTOCOL, **request}))
        reply = unpack_facts(sock.recv(1 << 16))
        if reply is not None and "refused" in reply:
            raise UsageError(reply["refused"])
        return reply
    return None
