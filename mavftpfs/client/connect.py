"""Builds link, connection and tree from the options, for mounts and one-shot commands. Layer: client."""

from __future__ import annotations

import errno
import hashlib
import os
import stat
import sys
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager, nullcontext
from dataclasses import dataclass, fields, replace
from datetime import datetime
from functools import partial
from pathlib import Path
from random import SystemRandom
from typing import Any

import trio

from mavftpfs.cache.options import CacheOptions
from mavftpfs.cache.tree import Tree
from mavftpfs.client.several import ON_COMMAND_LINE, unnamed_by
from mavftpfs.client.status import snapshot
from mavftpfs.client.trace import TlogWriter, text_line
from mavftpfs.client.undelivered import rescue, spool_for
from mavftpfs.client.watcher import Watcher
from mavftpfs.link.base import Link, plain_nursery
from mavftpfs.link.hublink import PortRequest
from mavftpfs.link.messages import OWN_COMPONENT, Address, AutopilotVersion
from mavftpfs.link.samelink import leads_back
from mavftpfs.link.sharing import open_shared
from mavftpfs.link.uri import LinkKind, LinkSpec, parse_source
from mavftpfs.session.connection import Connection, ConnectOptions, connected
from mavftpfs.session.driver import PayloadSink
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import (
    FtpNak,
    ListingIncomplete,
    NoFtp,
    NotADirectory,
    NotFound,
    RequestTimeout,
    SessionBusy,
    UsageError,
    VehicleLost,
)
from mavftpfs.shared.model import ROOT
from mavftpfs.shared.options import Options

MIB = 1 << 20
KEY_SIZE = 32
BITS_PER_BYTE = 10
"""Bits of a byte on a serial port: eight, and a start and a stop bit."""


@dataclass(frozen=True, slots=True)
class Space:
    """The card's size and free space in bytes."""

    total: int
    free: int


@dataclass(frozen=True, slots=True)
class Attached:
    """A connected vehicle and its files.

    watcher: a program that keeps running has to run it. notice: moves the files of earlier mounts to a
    recovery directory, and returns a line about them, or "".
    """

    connection: Connection
    tree: Tree
    watcher: Watcher
    notice: Callable[[], str] = str

    def status(self) -> dict[str, Any]:
        """Return the facts about vehicle, link and files, JSON-able."""
        return snapshot(self.connection.status(), self.tree.status(), self.watcher.traffic)

    def space(self) -> Space | None:
        """Return the space in the vehicle's STORAGE_INFORMATION, None before that was received."""
        storage = self.connection.vehicle.storage
        if storage is None or not storage.total_capacity > 0:
            return None
        free = min(max(storage.available_capacity, 0.0), storage.total_capacity)
        return Space(int(storage.total_capacity * MIB), int(free * MIB))


@dataclass(frozen=True, slots=True)
class Sinks:
    """Records of the link's traffic: FTP payloads, and whole frames. tell: receives lines for people about
    waiting for a vehicle."""

    payload: PayloadSink | None = None
    frame: Callable[[bytes], None] | None = None
    tell: Callable[[str], None] = lambda line: None


NO_SINKS = Sinks()


@contextmanager
def open_sinks(options: Options, *, debug: bool, tell: Callable[[str], None]) -> Iterator[Sinks]:
    """Open the records for tlog= and -d, and close them after the body; tell: see Sinks.

    Raises:
        UsageError: the file cannot be created.
    """
    payload = _print_payload if debug else None
    with nullcontext() if options.tlog is None else TlogWriter(options.tlog) as tlog:
        yield Sinks(payload, None if tlog is None else tlog.frame, tell)


def _print_payload(now: float, direction: str, wire: bytes) -> None:
    print(f"{datetime.now():%H:%M:%S.%f} {text_line(direction, wire)}", file=sys.stderr)


@asynccontextmanager
async def opened(spec: LinkSpec, options: Options, *, shared: bool = False) -> AsyncIterator[Link]:
    """Open a link for the length of the body, alone or with other mavftpfs programs.

    shared: share the link from the beginning.

    Raises:
        LinkClosed: as open_shared. UsageError: an endpoint of forward= is SOURCE itself.
    """
    own = Address(options.source_system, OWN_COMPONENT)
    wanted = PortRequest(own, options.forward, process_name(), shared)
    for place in options.forward:
        if leads_back(parse_source(place), spec):
            raise UsageError(
                f"forward={place} is SOURCE itself; name another place, such as udpout:127.0.0.1:14551"
            )
    async with open_shared(spec, wanted) as link:
        yield link


def waiting(spec: LinkSpec, options: Options) -> str:
    """Return the line for a person while mavftpfs waits for a vehicle."""
    return f"waiting for a heartbeat on {spec.description} ({options.connect_timeout:g} s)"


@asynccontextmanager
async def attached(
    spec: LinkSpec,
    options: Options,
    *,
    invalidate: Callable[[bytes], None] = lambda path: None,
    sinks: Sinks = NO_SINKS,
    list_root: bool = True,
    writing: bool = False,
    rescue_for: str | None = None,
) -> AsyncIterator[Attached]:
    """Connect, wait for the first heartbeat and the first listing, and keep the connection for the length of
    the body.

    list_root: False if the body itself sends a request at once, as a command that waits for other clients
    does. writing: the body may change the tree, unless the options forbid it. Pending changes then go into a
    spool that survives the process. rescue_for: `Attached.notice` moves the files that earlier mounts left
    there to a recovery directory named after this SOURCE; it is called when its line can be shown to a
    person. Without rescue_for this program, too, leaves no file in the spool, because the local originals
    still exist.

    Raises:
        LinkClosed, VehicleLost, NoFtp: within connect_timeout, with the reason.
        UsageError: the remote root is not a directory.
    """
    deadline = trio.current_time() + options.connect_timeout
    settings = replace(connect_options(options), patient=not list_root)
    async with (
        opened(spec, options) as link,
        connected(link, settings, on_payload=sinks.payload, on_frame=sinks.frame) as connection,
    ):
        await connection.ready(options.connect_timeout, partial(sinks.tell, waiting(spec, options)))
        async with with_tree(
            connection, spec, options, invalidate=invalidate, writing=writing, rescue_for=rescue_for
        ) as vehicle:
            if list_root:
                await _list_root(connection, vehicle.tree, deadline, options)
            yield vehicle


@asynccontextmanager
async def with_tree(
    connection: Connection,
    spec: LinkSpec,
    options: Options,
    *,
    invalidate: Callable[[bytes], None] = lambda path: None,
    writing: bool = False,
    rescue_for: str | None = None,
) -> AsyncIterator[Attached]:
    """Give a connected vehicle's files to the body; arguments as of `attached`."""
    writing = writing and not options.read_only
    caches = replace(cache_options(options, spec), read_only=not writing)
    async with plain_nursery() as nursery:
        with spool_for(connection.vehicle.address) if writing else nullcontext() as spool:

            def notice() -> str:
                left = rescue(spool, rescue_for) if spool is not None and rescue_for is not None else ""
                unnamed = unnamed_by(connection, options)
                others = "" if unnamed is None else unnamed.note(ON_COMMAND_LINE)
                return "; ".join(filter(None, (others, left)))

            tree = Tree(
                connection.store,
                caches,
                clock=trio.current_time,
                invalidate=invalidate,
                nursery=nursery,
                spool=spool,
                rng=SystemRandom(),
            )
            subscribe(connection, tree)
            try:
                yield Attached(connection, tree, Watcher(connection.status, writing=writing), notice)
                await tree.tidy_up()
            finally:
                connection.news.clear()  # the tree can begin nothing while the session is closed
                if spool is not None and (rescue_for is None or not (tree.undelivered() or tree.broken())):
                    spool.discard()


def process_name() -> str:
    """Return this program's name for the hub's lists."""
    path = Path(sys.argv[0] if sys.argv else "")
    name = path.parent.name if path.name == "__main__.py" else path.name
    return f"{'python' if name in ('', '-c') else name} (process {os.getpid()})"


async def _list_root(connection: Connection, tree: Tree, deadline: float, options: Options) -> None:
    try:
        with trio.move_on_at(deadline):
            await tree.list(ROOT)
            return
    except ListingIncomplete:
        return  # the program that lists the root gets the error
    except (RequestTimeout, VehicleLost):
        pass  # for the user this is no answer, too
    except SessionBusy as exc:
        raise NoFtp(f"another client keeps the only FTP session of {_vehicle(connection)} in use") from exc
    except (NotFound, NotADirectory, FtpNak) as exc:
        if options.root == ROOT or errno_for(exc) not in (errno.ENOENT, errno.ENOTDIR):
            raise NoFtp(f"{_vehicle(connection)} does not show its files: {exc}") from exc
        raise UsageError(
            f"{options.root.decode(errors='replace')} is not a directory of the vehicle"
        ) from exc
    raise no_answer(connection, options)


def no_answer(connection: Connection, options: Options) -> NoFtp:
    """Return the error for a vehicle that answers no FTP request within connect_timeout."""
    return NoFtp(
        f"{_vehicle(connection)} sends heartbeats but did not answer MAVLink FTP "
        f"within {options.connect_timeout:g} s ({_flag(connection)})"
    )


def _vehicle(connection: Connection) -> str:
    address = connection.vehicle.address
    return "the vehicle" if address is None else f"vehicle {address.system}/{address.component}"


def _flag(connection: Connection) -> str:
    flag = connection.vehicle.ftp_flag
    if flag is None:
        return "it did not say whether it supports FTP"
    return "it says it supports FTP" if flag else "it says it does not support FTP"


def subscribe(connection: Connection, tree: Tree) -> None:
    """Report all events of the vehicle and the link to a tree, from now on."""
    reactions: dict[str, Callable[[], None]] = {
        "reboot": tree.rebooted,
        "back": tree.link_back,
        "armed": partial(tree.armed_changed, True),
        "disarmed": partial(tree.armed_changed, False),
    }

    def on_news(news: str) -> None:
        if news in reactions:
            reactions[news]()

    connection.subscribe(on_news)
    tree.armed_changed(connection.vehicle.armed)


def connect_options(options: Options) -> ConnectOptions:
    """Return the options for the session.

    Raises:
        UsageError: the signing key cannot be read.
    """
    key = None if options.signing_key is None else read_key(options.signing_key)
    return ConnectOptions(**_values(options), key=key)


def cache_options(options: Options, spec: LinkSpec) -> CacheOptions:
    """Return the options for the caches, for a link."""
    link_rate = spec.baud / BITS_PER_BYTE if spec.kind is LinkKind.SERIAL else None
    return CacheOptions(**_values(options), link_rate=link_rate)


def _values(options: Options) -> dict[str, Any]:
    return {field.name: getattr(options, field.name) for field in fields(Options)}


def read_key(path: str) -> bytes:
    """Return the MAVLink 2 signing key in a file: 32 raw bytes, 64 hex digits, or a passphrase.

    A passphrase becomes a key by SHA-256, as in ground stations.

    Raises:
        UsageError: the file cannot be read, is empty, or others can read it, too (the same rule as ssh's).
    """
    try:
        with Path(path).open("rb") as file:
            facts = os.fstat(file.fileno())
            content = file.read()
    except OSError as exc:
        raise UsageError(f"signing_key={path}: {exc.strerror}") from exc
    if facts.st_mode & (0o077 if facts.st_uid == os.getuid() else 0o007):
        mode = f"{stat.S_IMODE(facts.st_mode):04o}"
        raise UsageError(f"signing_key={path}: mode {mode} lets others use the key; run: chmod 600 {path}")
    if len(content) == KEY_SIZE:
        return content
    text = content.strip()
    if not text:
        raise UsageError(f"signing_key={path}: the file is empty")
    try:
        key = bytes.fromhex(text.decode("ascii"))
    except ValueError:
        key = b""
    return key if len(key) == KEY_SIZE else hashlib.sha256(text).digest()


VERSION_PATIENCE = 5.0
"""Seconds for a vehicle to send AUTOPILOT_VERSION, which contains its unique id."""
_VERSION_POLL = 0.02


async def told_version(connection: Connection) -> AutopilotVersion | None:
    """Return the vehicle's AUTOPILOT_VERSION, None if it sends none. Each connection asks for it."""
    with trio.move_on_after(VERSION_PATIENCE):
        while connection.vehicle.version is None:  # noqa: ASYNC110 (for once)
            await trio.sleep(_VERSION_POLL)
    return connection.vehicle.version
