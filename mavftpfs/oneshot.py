"""Commands on a vehicle without a kernel mount: list, get, checksum, scan. Layer: top; prints nothing."""

from __future__ import annotations

import os
import secrets
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractAsyncContextManager, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import trio

from mavftpfs.cache.tree import OpenFile, Stat, Tree
from mavftpfs.compose import NO_SINKS, Attached, Sinks, attached, connect_options
from mavftpfs.fuse.options import MountOptions
from mavftpfs.link.base import Link
from mavftpfs.link.messages import MAV_TYPE_GCS, Address, Heartbeat
from mavftpfs.link.opening import open_link
from mavftpfs.link.uri import LinkSpec
from mavftpfs.protocol.crc import crc32
from mavftpfs.protocol.url import MftpUrl, is_url, parse_url
from mavftpfs.session.connection import connected
from mavftpfs.shared.errors import (
    Armed,
    DataUnproven,
    FtpNak,
    IsADirectory,
    LocalProtocolError,
    MavftpfsError,
    RequestTimeout,
    UsageError,
    VehicleLost,
)
from mavftpfs.shared.model import EntryKind, is_virtual, join, normalise, split
from mavftpfs.shared.readable import autopilot_name, name_text

if TYPE_CHECKING:  # rich is slow to import and not needed here
    from mavftpfs.report import Meter

READ_SIZE = 128 * 1024
PART_SUFFIX = ".part"
LISTEN_TIME = 3.0
"""Seconds in which every component sends its heartbeat at least twice."""
PROBE_TIME = 6.0
"""Seconds to wait for a component's answer to a listing."""


@dataclass(frozen=True, slots=True)
class Fetched:
    """One file that was fetched. proof: how its bytes were verified, for a person."""

    remote: bytes
    local: Path
    size: int
    proof: str


@dataclass(frozen=True, slots=True)
class Target:
    """Which vehicle, and how to talk to it."""

    spec: LinkSpec
    options: MountOptions
    sinks: Sinks = NO_SINKS

    def attached(self, *, writing: bool = False) -> AbstractAsyncContextManager[Attached]:
        """Return the connection; what the commands ask for is its first listing."""
        return attached(self.spec, self.options, sinks=self.sinks, list_root=False, writing=writing)


Entry = dict[str, Any]


Listing = tuple[str | None, list[Entry]]
"""A directory's name and what it holds; None: the path is a file, the only entry."""


async def list_paths(target: Target, paths: list[bytes]) -> list[Listing]:
    """Return the entries of directories, and files themselves, as JSON-able facts."""
    async with target.attached() as vehicle:
        return [await _list_path(vehicle.tree, path) for path in paths]


async def _list_path(tree: Tree, path: bytes) -> Listing:
    found = await tree.stat(path)
    if found.kind is EntryKind.FILE:
        return None, [_entry(path, split(path)[1], found)]
    below = sorted(await tree.list(path), key=lambda entry: entry[0])
    return name_text(path), [_entry(join(path, name), name, stat) for name, stat in below]


def _entry(path: bytes, name: bytes, found: Stat) -> Entry:
    return {
        "path": path.decode("utf-8", "surrogateescape"),
        "name": name.decode("utf-8", "surrogateescape"),
        "kind": found.kind.name.lower(),
        "size": found.size,
        "mtime": found.mtime,
    }


async def checksum_paths(target: Target, paths: list[bytes], tell: Callable[[bytes, int], None]) -> None:
    """Have the vehicle compute CRC32s; `tell(path, crc)` for each.

    Raises:
        IsADirectory. Else as Tree.stat and crc32.
    """
    async with target.attached() as vehicle:
        for path in paths:
            if (await vehicle.tree.stat(path)).kind is not EntryKind.FILE:
                raise IsADirectory(f"{name_text(path)} is a directory")
            tell(path, await vehicle.tree.crc32(path))


async def get_paths(
    target: Target,
    paths: list[bytes],
    local: Path,
    meter: Meter,
    tell: Callable[[Fetched], None],
    *,
    recursive: bool,
) -> None:
    """Fetch files, and with `recursive` directories, to `local` (a directory, or a new name for one file).

    Raises:
        DataUnproven: size or checksum disagreed twice; no file is left under the final name.
        IsADirectory: a directory without `recursive`. UsageError: the local disk does not take it.
    """
    async with target.attached() as vehicle:
        tree = vehicle.tree
        getter = _Getter(tree, meter, virtual_root=is_virtual(target.options.root))
        for path in paths:
            found = await tree.stat(path)
            if found.kind is EntryKind.DIRECTORY and not recursive:
                raise IsADirectory(f"{name_text(path)} is a directory; get it with -r")
            place = _local_name(local, path, single=len(paths) == 1)
            await getter.get_tree(path, place, found, tell)


def _local_name(local: Path, path: bytes, *, single: bool) -> Path:
    name = os.fsdecode(split(path)[1])
    return local / name if local.is_dir() or not single else local


@contextmanager
def _local_disk(place: Path) -> Iterator[None]:
    """Turn what the local disk refuses into an error that says so in a line."""
    try:
        yield
    except OSError as exc:
        raise UsageError(f"{place}: {exc.strerror}") from exc


@dataclass(frozen=True, slots=True)
class _Getter:
    """Fetches files that are proven before they get their names."""

    tree: Tree
    meter: Meter
    virtual_root: bool

    async def get_tree(self, path: bytes, local: Path, found: Stat, tell: Callable[[Fetched], None]) -> None:
        """Fetch a file, or a directory with all below; the tree holds no names that climb."""
        pending = [(path, local, found)]
        while pending:
            remote, place, stat = pending.pop()
            if stat.kind is EntryKind.FILE:
                with _local_disk(place):
                    fetched = await self.get(remote, place, stat)
                tell(fetched)
                continue
            with _local_disk(place):
                place.mkdir(parents=True, exist_ok=True)
            for name, below in reversed(await self.tree.list(remote)):
                pending.append((join(remote, name), place / os.fsdecode(name), below))

    async def get(self, remote: bytes, local: Path, found: Stat) -> Fetched:
        """Fetch one file under a temporary name and rename it when its bytes are proven; tries twice."""
        part = local.with_name(f".{secrets.token_hex(8)}{PART_SUFFIX}")  # no name of the user's
        try:
            try:
                size, proof = await self._fetch_and_prove(remote, part)
            except DataUnproven:
                self.tree.forget_caches()
                size, proof = await self._fetch_and_prove(remote, part)
            os.utime(part, (found.mtime, found.mtime))
            part.replace(local)
        finally:
            part.unlink(missing_ok=True)
        return Fetched(remote, local, size, proof)

    async def _fetch_and_prove(self, remote: bytes, part: Path) -> tuple[int, str]:
        file = await self.tree.open(remote)
        try:
            with part.open("wb") as out:
                crc = await _copy(file, out, self.meter.start(name_text(remote), file.size))
        finally:
            file.close()
        return file.size, await self._prove(remote, crc, file.size)

    async def _prove(self, remote: bytes, crc: int, size: int) -> str:
        """Compare with the vehicle's own checksum where it can give one; returns what was proven.

        Raises:
            DataUnproven: they differ.
        """
        if self.virtual_root or is_virtual(remote):
            return "size (generated at each opening, so a checksum proves nothing)"
        try:
            theirs = await self.tree.crc32(remote)
        except Armed:
            return "size (no checksums while armed)"
        except FtpNak:
            return "size (the vehicle refused to compute a checksum)"
        except RequestTimeout:
            return "size (the vehicle did not answer the checksum request)"
        if theirs != crc:
            raise DataUnproven(
                f"{name_text(remote)}: {size} bytes came with CRC32 {crc:08x}, the vehicle has {theirs:08x}"
            )
        return "size and CRC32"


async def _copy(file: OpenFile, out: BinaryIO, advance: Callable[[int], None]) -> int:
    """Copy a file and return its CRC32."""
    crc = offset = 0
    while offset < file.size:
        data = await file.read(offset, READ_SIZE)
        if not data:
            raise DataUnproven(f"the file ended at {offset} of {file.size} bytes")
        out.write(data)
        crc = crc32(data, crc)
        offset += len(data)
        advance(len(data))
    return crc


# -- scan -----------------------------------------------------------------------------------------


async def scan(target: Target) -> list[Entry]:
    """Return who sends heartbeats on a link, and who of them answers MAVLink FTP.

    Raises:
        VehicleLost: nobody at all within connect_timeout.
    """
    options = target.options
    async with open_link(target.spec) as link:
        heard = await _listen(link, options)
        return [await _probe(link, options, heard[address]) for address in sorted(heard)]


async def _listen(link: Link, options: MountOptions) -> dict[Address, Heartbeat]:
    anybody = replace(connect_options(options), target_system=0, target_component=0)
    async with connected(link, anybody) as connection:
        try:
            await connection.ready(options.connect_timeout)
        except VehicleLost:
            if not connection.vehicle.heard:
                raise
        await trio.sleep(LISTEN_TIME)
        return dict(connection.vehicle.heard)


async def _probe(link: Link, options: MountOptions, heartbeat: Heartbeat) -> Entry:
    address = heartbeat.source
    entry: Entry = {
        "system": address.system,
        "component": address.component,
        "what": describe_peer(heartbeat),
        "autopilot": heartbeat.autopilot,
        "type": heartbeat.vehicle_type,
        "armed": heartbeat.armed,
        "ftp": "not asked (a ground station)",
        "answers": None,
    }
    if heartbeat.vehicle_type == MAV_TYPE_GCS:
        return entry
    target = replace(
        connect_options(options), target_system=address.system, target_component=address.component
    )
    async with connected(link, target) as connection:
        try:
            await connection.ready(PROBE_TIME)
            with trio.move_on_after(PROBE_TIME) as scope:
                await connection.store.list_directory(options.root)
            answer = "no answer" if scope.cancelled_caught else "answers"
        except FtpNak as exc:
            answer = f"answers, but: {exc}"
        except MavftpfsError as exc:
            answer = f"no answer ({exc})"
        facts = connection.status()
    entry.update(ftp=answer, answers=answer.startswith("answers"), facts=facts)
    return entry


def describe_peer(heartbeat: Heartbeat) -> str:
    """Return what a heartbeat says its sender is."""
    if heartbeat.vehicle_type == MAV_TYPE_GCS:
        return "ground station"
    kind = autopilot_name(heartbeat.autopilot)
    if not heartbeat.is_autopilot:
        return f"component (type {heartbeat.vehicle_type})"
    return f"{kind}, {'armed' if heartbeat.armed else 'disarmed'}"


def parse_paths(texts: Sequence[str]) -> tuple[list[bytes], int | None]:
    """Return the normalised remote paths, and the component that mftp:// URLs among them name.

    Raises:
        UsageError: `..` or NUL, a malformed URL, or two components at once.
    """
    paths, components = [], set()
    for text in texts:
        url = parse_url(text) if is_url(text) else MftpUrl(None, _plain_path(text))
        paths.append(url.path)
        components |= {url.component} - {None}
    if len(components) > 1:
        raise UsageError("the URLs name several components; ask one at a time")
    return paths, components.pop() if components else None


def _plain_path(text: str) -> bytes:
    try:
        return normalise(os.fsencode(text))
    except LocalProtocolError as exc:
        raise UsageError(str(exc)) from exc
