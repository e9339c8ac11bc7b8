"""Fetching files and directories to the local disk, or to stdout. Layer: top; prints nothing."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import trio

from mavftpfs.cache.attributes import Stat
from mavftpfs.cache.virtual import is_snapshot
from mavftpfs.oneshot.fetch import Fetched, Fetcher, LocalDiskFull, Wanted, local_disk, part_of
from mavftpfs.oneshot.files import READ_SIZE, Session
from mavftpfs.oneshot.plan import Verify, known_time, proof_needed
from mavftpfs.protocol.crc import crc32
from mavftpfs.shared.errors import (
    Armed,
    DataUnproven,
    FtpNak,
    IsADirectory,
    LinkError,
    MavftpfsError,
    NotDeliveredYet,
    NotSupported,
    RequestTimeout,
)
from mavftpfs.shared.model import EntryKind, join, split
from mavftpfs.shared.readable import name_text

Tell = Callable[[Fetched], None]
Complain = Callable[[MavftpfsError], None]


@dataclass(slots=True)
class Got:
    """How far a run came. planned: files that were found; failed: what was complained of."""

    planned: int = 0
    done: int = 0
    failed: int = 0


@dataclass(slots=True)
class _Getter:
    session: Session
    recursive: bool
    complain: Complain
    got: Got
    keep_going: bool
    found: list[tuple[bytes, Path, Stat]] = field(default_factory=list)

    def failed(self, error: MavftpfsError) -> None:
        """Say it and go on, or end where only one thing was asked for."""
        if not self.keep_going or isinstance(error, LinkError | LocalDiskFull):
            raise error
        self.got.failed += 1
        self.complain(error)

    async def plan(self, path: bytes, place: Path) -> None:
        """Collect the files of a path, and make the directories for them."""
        try:
            found = await self.session.files.stat(path)
            if found.kind is EntryKind.DIRECTORY and not self.recursive:
                raise IsADirectory(f"{name_text(path)} is a directory; get it with -r")
        except MavftpfsError as exc:
            self.failed(exc)
            return
        pending = [(path, place, found)]
        while pending:
            remote, local, stat = pending.pop()
            if stat.kind is EntryKind.FILE:
                self.found.append((remote, local, stat))
                continue
            try:
                with local_disk(local):
                    local.mkdir(parents=True, exist_ok=True)
                entries = await self.session.files.list(remote)
            except MavftpfsError as exc:
                self.failed(exc)
                continue
            self.keep_going = True
            for name, below in reversed(entries):
                pending.append((join(remote, name), local / os.fsdecode(name), below))

    def wanted(self) -> list[Wanted]:
        """Return what was found, as Fetcher takes it."""
        finals = {local for _, local, _ in self.found}
        return [
            Wanted(
                remote, local, name_text(remote), stat.size, known_time(stat.mtime), part_of(local, finals)
            )
            for remote, local, stat in self.found
        ]


async def get_paths(
    fetcher: Fetcher,
    paths: Sequence[bytes],
    local: Path,
    tell: Tell,
    complain: Complain,
    got: Got,
    *,
    recursive: bool,
) -> None:
    """Fetch files, and with `recursive` directories, to `local` (a directory, or a new name for one file).

    Of several things the others go on when one fails, which `complain` is told; `got` counts them.

    Raises:
        As Fetcher.fetch where only one file is asked for; LinkError, and a full local disk, always.
    """
    getter = _Getter(fetcher.session, recursive, complain, got, keep_going=len(paths) > 1)
    for path in paths:
        await getter.plan(path, local_name(local, path, single=len(paths) == 1))
    all_wanted = getter.wanted()
    got.planned = len(all_wanted)
    fetcher.progress.plan(got.planned, sum(wanted.size for wanted in all_wanted))
    for wanted in all_wanted:
        try:
            fetched = await fetcher.fetch(wanted)
        except MavftpfsError as exc:
            getter.failed(exc)
        else:
            got.done += 1
            tell(fetched)
        fetcher.progress.end(wanted.size)


def local_name(local: Path, path: bytes, *, single: bool) -> Path:
    """Return where a remote path goes: into a directory, or under the new name of a single thing."""
    name = os.fsdecode(split(path)[1])
    return local / name if local.is_dir() or not single else local


# -- to stdout ------------------------------------------------------------------------------------


async def cat_paths(
    session: Session, paths: Sequence[bytes], out: BinaryIO, verify: Verify, complain: Complain, got: Got
) -> None:
    """Write files one behind the other to `out`, and prove what was written.

    Raises:
        As get_paths. DataUnproven: what was written is not what the vehicle has.
    """
    got.planned = len(paths)
    for path in paths:
        try:
            await _cat(session, path, out, verify)
            got.done += 1
        except MavftpfsError as exc:
            if len(paths) == 1 or isinstance(exc, LinkError):
                raise
            got.failed += 1
            complain(exc)


async def _cat(session: Session, path: bytes, out: BinaryIO, verify: Verify) -> None:
    if (await session.files.stat(path)).kind is EntryKind.DIRECTORY:
        raise IsADirectory(f"{name_text(path)} is a directory")
    file = await session.files.open(path)
    crc = offset = 0
    try:
        while offset < file.size:
            data = await file.read(offset, READ_SIZE)
            if not data:
                raise DataUnproven(f"{name_text(path)} ended at {offset} of {file.size} bytes")
            crc = crc32(data, crc)
            offset += len(data)
            # In a thread: who reads may take its time, and the vehicle is to hear of us meanwhile.
            await trio.to_thread.run_sync(_write, out, bytes(data), abandon_on_cancel=True)
    finally:
        file.close()
    if is_snapshot(session.on_vehicle(path)) or not proof_needed(verify, resumed=False, size=offset):
        return
    try:
        theirs = await session.files.crc32(path)
    except (Armed, NotDeliveredYet, RequestTimeout, FtpNak, NotSupported):
        return
    if theirs != crc:
        raise DataUnproven(
            f"{name_text(path)}: what was written has CRC32 {crc:08x}, the vehicle's file {theirs:08x}"
        )


def _write(out: BinaryIO, data: bytes) -> None:
    out.write(data)
    out.flush()
