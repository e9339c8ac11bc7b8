"""A vehicle that can be written, in memory: FakeStore with cache.remote.VehicleStore, of any kind of server.

`Kind` says how it behaves. Failures are put on requests by number: every request of the writing side, and
every chunk of an upload, counts as one.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from dataclasses import dataclass
from random import Random
from typing import Any

import pytest
import trio

from mavftpfs.cache.options import CacheOptions
from mavftpfs.cache.recovery import SpoolDirectory
from mavftpfs.cache.remote import ReadSink
from mavftpfs.cache.reserved import is_reserved
from mavftpfs.cache.tree import Tree
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.shared.errors import (
    AlreadyExists,
    Armed,
    FileChanged,
    FtpNak,
    MavftpfsError,
    VehicleLost,
)
from mavftpfs.shared.extents import ExtentSet
from mavftpfs.shared.model import ROOT, Traits, join, split, wire_path
from mavftpfs.shared.sending import Sending
from tests.support.fake_store import FakeFile, FakeReader, FakeStore

CHUNK = 239


@dataclass(frozen=True, slots=True)
class Kind:
    """How a server behaves.

    replaces: rename over a file works (else FileExists, as FAT). moves_into: rename onto a directory moves
    into it, as NuttX. renames: there is a rename at all. wo_truncates: OpenFileWO empties. folds_case: names
    are found in any case. drops_ends: dots and blanks at the end of a name are dropped.
    """

    replaces: bool = True
    moves_into: bool = False
    renames: bool = True
    wo_truncates: bool = False
    folds_case: bool = False
    drops_ends: bool = False


KINDS = {
    "posix": Kind(),
    "nuttx": Kind(moves_into=True),
    "fat": Kind(replaces=False, folds_case=True, drops_ends=True),
    "littlefs": Kind(renames=False),
    "mavsdk": Kind(wo_truncates=True),
}


class Frozen(VehicleLost):
    """The vehicle lost power: nothing changes any more."""


class FakeWriter(FakeStore):
    """Files in memory that can be changed.

    Attributes:
        traits: whether the card can rename was found out before.
        requests: how many changing requests were executed or failed.
        log: what they were. fail_at: number -> error raised instead of executing it.
        freeze_at: from this number on nothing is executed (power lost).
        capacity: bytes of all files; beyond that WriteFile is refused.
        before_request: called with what is asked, before anything is decided.
        linger: seconds that it takes to give up an upload.
        spoil_uploads: how many more uploads arrive with a wrong byte.
    """

    def __init__(self, kind: Kind | None = None, nursery: trio.Nursery | None = None) -> None:
        super().__init__(nursery)
        self.kind = kind or Kind()
        self.traits = Traits(rename_works=self.kind.renames)
        self.requests = 0
        self.log: list[tuple[str, ...]] = []
        self.fail_at: dict[int, MavftpfsError] = {}
        self.freeze_at: int | None = None
        self.capacity: int | None = None
        self.spoil_uploads = 0
        self.write_delay = 0.0
        self.linger = 0.0
        self.uploads: list[FakeUpload] = []
        self.before_request: Callable[..., object] | None = None

    # --- what requests go through

    async def request(self, *what: object, in_flight: bool = False) -> None:
        """Count a request; raise if it is to fail."""
        await trio.lowlevel.checkpoint()
        if self.before_request is not None:
            self.before_request(*what)
        if self.write_delay:
            await trio.sleep(self.write_delay)
        self.require_link()
        if self.armed and not in_flight:
            raise Armed("armed")
        self.requests += 1
        if self.freeze_at is not None and self.requests > self.freeze_at:
            self.requests -= 1
            raise Frozen("the power is gone")
        self.log.append(tuple(str(part) for part in what))
        error = self.fail_at.pop(self.requests, None)
        if error is not None:
            raise error

    def require_link(self) -> None:
        super().require_link()
        if self.freeze_at is not None and self.requests >= self.freeze_at:
            raise Frozen("the power is gone")

    def revive(self) -> None:
        """The power is back."""
        self.freeze_at = None
        self.fail_at.clear()

    def real(self, path: bytes) -> bytes:
        """Return the stored spelling of a path."""
        if self.kind.drops_ends:
            path = path.rstrip(b". ")
        if path in self.files or path in self.directories or not self.kind.folds_case:
            return path
        for known in [*self.files, *self.directories]:
            if known.lower() == path.lower():
                return known
        return path

    @property
    def used(self) -> int:
        """Bytes of all files."""
        return sum(len(file.data) for file in self.files.values())

    # --- VehicleStore

    async def open_upload(self, path: bytes, source: Sending) -> FakeUpload:
        wire_path(path)
        upload = FakeUpload(self, path, source)
        self.uploads.append(upload)
        return upload

    async def create_empty(self, path: bytes) -> None:
        wire_path(path)
        await self.request("create", path)
        self._create(path)

    def in_doubt(self, since: float = 0.0) -> bool:
        return False

    async def remove(self, path: bytes) -> None:  # type: ignore[override]  # FakeStore's sets the scene
        await self.request("remove", path)
        path = self.real(path)
        if path in self.directories:
            self.crimes.append(f"RemoveFile of the directory {path!r}")
        self._file(path, Opcode.REMOVE_FILE)
        del self.files[path]
        self._end_readers(path)

    async def make_directory(self, path: bytes) -> None:
        await self.request("mkdir", path)
        path = self.real(path)
        if path in self.directories or path in self.files:
            raise FtpNak(Opcode.CREATE_DIRECTORY, NakCode.FILE_EXISTS)
        self._require_parent(path, Opcode.CREATE_DIRECTORY)
        self.directories.add(path)

    async def remove_directory(self, path: bytes) -> None:
        await self.request("rmdir", path)
        path = self.real(path)
        if path in self.files:
            self.crimes.append(f"RemoveDirectory of the file {path!r}")
        if path not in self.directories:
            raise FtpNak(Opcode.REMOVE_DIRECTORY, NakCode.FILE_NOT_FOUND)
        if any(split(p)[0] == path and p != ROOT for p in [*self.files, *self.directories]):
            self.crimes.append(f"RemoveDirectory of the full {path!r}")
            raise FtpNak(Opcode.REMOVE_DIRECTORY, NakCode.FAIL)
        self.directories.discard(path)

    async def rename(self, old: bytes, new: bytes, *, completes: bool = False) -> None:
        assert len(wire_path(old)) + 1 + len(wire_path(new)) <= 238, "does not fit a request"
        await self.request("rename", old, new, in_flight=completes)
        if not self.kind.renames:
            raise FtpNak(Opcode.RENAME, NakCode.FAIL_ERRNO, 2)
        self._rename(self.real(old), new)

    async def stat_size(self, path: bytes) -> int:
        await trio.lowlevel.checkpoint()
        self.require_link()
        self.log.append(("stat", str(path)))
        return len(self._file(path, Opcode.OPEN_FILE_RO).data)

    # --- inside

    def _file(self, path: bytes, opcode: Opcode) -> FakeFile:
        file = self.files.get(self.real(path))
        if file is None:
            raise FtpNak(opcode, NakCode.FILE_NOT_FOUND)
        return file

    def _require_parent(self, path: bytes, opcode: Opcode) -> None:
        if split(path)[0] not in self.directories:
            raise FtpNak(opcode, NakCode.FILE_NOT_FOUND)

    def _create(self, path: bytes) -> None:
        path = self.real(path)
        if path in self.directories:
            self.crimes.append(f"CreateFile on the directory {path!r}")
            raise FtpNak(Opcode.CREATE_FILE, NakCode.FAIL)
        self._require_parent(path, Opcode.CREATE_FILE)
        self.files[path] = FakeFile(b"")

    def _rename(self, old: bytes, new: bytes) -> None:
        if old not in self.files and old not in self.directories:
            raise FtpNak(Opcode.RENAME, NakCode.FILE_NOT_FOUND)
        there = self.real(new)
        if there in self.directories:
            if not self.kind.moves_into:
                raise FtpNak(Opcode.RENAME, NakCode.FILE_EXISTS)
            self.crimes.append(f"{old!r} moved into {new!r}")
            new = join(new, split(old)[1])
        elif there in self.files and there != old:
            if not self.kind.replaces:
                raise FtpNak(Opcode.RENAME, NakCode.FILE_EXISTS)
            del self.files[there]
            self._end_readers(there)
        elif there == old and there != new and not self.kind.replaces:
            raise FtpNak(Opcode.RENAME, NakCode.FILE_EXISTS)  # FatFs sees the name itself
        self._require_parent(new, Opcode.RENAME)
        self._move(old, new)

    def _move(self, old: bytes, new: bytes) -> None:
        def moved(path: bytes) -> bytes:
            return new + path[len(old) :] if path == old or path.startswith(old + b"/") else path

        self.files = {moved(path): file for path, file in self.files.items()}
        self.directories = {moved(path) for path in self.directories}
        for reader in self.readers:  # as the session has it
            reader.path = moved(reader.path)

    def _end_readers(self, path: bytes) -> None:
        """The session ends the readers of what we removed or replaced."""
        for reader in self.readers:
            if reader.path == path and not reader.closed:
                reader.demand = ExtentSet()
                reader.ahead = ExtentSet()
                reader.sink.on_failed(FileChanged(f"{path!r} was removed or replaced"))

    async def crc32(self, path: bytes, *, size: int | None = None) -> int:
        return await super().crc32(self.real(path), size=size)

    async def open_reader(
        self, path: bytes, sink: ReadSink, *, expected_size: int | None = None
    ) -> FakeReader:
        return await super().open_reader(self.real(path), sink, expected_size=expected_size)


def card(
    files: Mapping[bytes, bytes], *, directories: Sequence[bytes] = (), kinds: Sequence[str] = ("posix",)
) -> Any:
    """Return a fixture: a vehicle with these files and empty directories, of each kind in turn; it must end
    without a complaint."""

    @pytest.fixture(params=kinds if len(kinds) > 1 else None)
    async def vehicle(
        request: pytest.FixtureRequest, nursery: trio.Nursery, autojump_clock: object
    ) -> AsyncIterator[FakeWriter]:
        store = FakeWriter(KINDS[getattr(request, "param", kinds[0])], nursery)
        for path, data in files.items():
            store.add(path, data)
        for path in directories:
            store.add_directory(path)
        yield store
        assert store.crimes == []
        nursery.cancel_scope.cancel()

    return vehicle


def make_writable(
    store: FakeWriter, *, spool: SpoolDirectory | None = None, seed: int = 1, **options: Any
) -> Tree:
    """Return a tree that writes to a store, with the store's nursery; seeded."""
    return Tree(
        store,
        CacheOptions(**options),
        clock=trio.current_time,
        invalidate=store.invalidated.append,
        nursery=store.nursery,
        spool=spool,
        wall=lambda: 1_700_000_000.0,
        rng=Random(seed),
    )


async def write_file(tree: Tree, path: bytes, data: bytes, step: int = 128 * 1024) -> None:
    """Make or replace a file, as `cp` does: every error shows."""
    try:
        file = await tree.create(path, exclusive=True)
    except AlreadyExists:
        file = await tree.open(path, write=True, truncate=True)
    try:
        for at in range(0, len(data), step):
            await file.write(at, data[at : at + step])
        await file.flush()
        await file.release()
    finally:
        file.close()


def litter(store: FakeWriter) -> list[bytes]:
    """Return which files under names of ours are left."""
    return [path for path in store.files if is_reserved(split(path)[1])]


async def list_all(store: FakeWriter, tree: Tree) -> None:
    """List every directory anew, twice over."""
    tree.forget_caches()
    for directory in [*store.directories, *store.directories]:
        await tree.list(directory)


class FakeUpload:
    """Sends chunk by chunk, each one request; in the background too if the store has a nursery."""

    def __init__(self, store: FakeWriter, path: bytes, source: Sending) -> None:
        self.path = path
        self.aborted = False
        self._store = store
        self._source = source
        self.begun = self.resent = False
        self._open = False
        self._opened_before = False
        self._sending = trio.Lock()
        self._background = False
        self._error: MavftpfsError | None = None

    def wake(self) -> None:
        """See Upload."""
        assert not self.aborted
        if self._store.nursery is not None and not self._background and self._error is None:
            self._background = True
            self._store.nursery.start_soon(self._run)

    async def finish(self) -> None:
        """See Upload."""
        assert not self.aborted
        self._error = None
        async with self._sending:
            await self._send_all()
            if not self._opened_before and not self._open:
                await self._open_file()
            if self._open:
                await self._terminate()

    async def abort(self) -> None:
        """See Upload."""
        self.aborted = True
        if self._sending.locked():  # what is under way is executed
            async with self._sending:
                pass
        self._open = False
        if self._store.linger:
            await trio.sleep(self._store.linger)

    async def _run(self) -> None:
        try:
            async with self._sending:
                await self._send_all()
        except MavftpfsError as error:
            self._error = error
        finally:
            self._background = False

    async def _send_all(self) -> None:
        while not self.aborted:
            chunk = self._source.next_chunk(CHUNK)
            if chunk is None:
                return
            if not self._open:
                self._source.on_unsent(chunk[0], len(chunk[1]))  # opening may have it start from 0 again
                await self._open_file()
                continue
            await self._write_chunk(*chunk)

    async def _write_chunk(self, offset: int, data: bytes) -> None:
        try:
            await self._write(offset, data)
        except BaseException as error:
            self._source.on_unsent(offset, len(data))
            if not isinstance(error, FtpNak):
                self._lose()
            raise

    def _lose(self) -> None:
        self._open = False
        self._source.roll_back(everything=self._store.kind.wo_truncates)

    async def _open_file(self) -> None:
        store = self._store
        reopened = self._opened_before and not store.kind.wo_truncates
        self.begun = True
        await store.request("open", self.path, "write" if reopened else "create")
        if not reopened:
            store._create(self.path)
            if self._opened_before:
                self._source.roll_back(everything=True)
        self._open = self._opened_before = True

    async def _write(self, offset: int, data: bytes) -> None:
        store = self._store
        await store.request("write", self.path, offset, len(data))
        file = store._file(self.path, Opcode.WRITE_FILE)
        if offset > len(file.data):
            store.crimes.append(f"a gap in {self.path!r}")
        if store.spoil_uploads:
            store.spoil_uploads -= 1
            data = bytes([data[0] ^ 1]) + data[1:]
        new = file.data[:offset].ljust(offset, b"\0") + data + file.data[offset + len(data) :]
        if store.capacity is not None and store.used - len(file.data) + len(new) > store.capacity:
            raise FtpNak(Opcode.WRITE_FILE, NakCode.FAIL_ERRNO, 28)
        file.data = new
        file.mtime = None
        self._source.on_acked(offset, len(data))

    async def _terminate(self) -> None:
        await self._store.request("terminate", self.path)
        self._open = False
        self._source.check_point()
