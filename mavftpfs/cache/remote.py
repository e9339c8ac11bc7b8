"""The calls that the caches make to the vehicle. Layer: cache; declared here, implemented by session.store.

All paths are normalised mount paths (shared.model). All calls raise only MavftpfsError.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from math import inf
from typing import Protocol

from mavftpfs.shared.model import Listing, Traits
from mavftpfs.shared.sending import SendBuffer


class ReadSink(Protocol):
    """Where a reader's bytes go. All methods are synchronous and must not block."""

    def missing(self, start: int, stop: int) -> list[tuple[int, int]]:
        """Return the parts of [start, stop) that are not here yet."""
        ...

    def on_opened(self, at: float) -> None:
        """The bytes that come from now on are of the file that the server opened at that time (the caches'
        clock). Called before the first byte of each session, perhaps more than once."""
        ...

    def on_data(self, offset: int, data: bytes) -> None:
        """Take bytes that the engine believed. Bytes that are already here must not be overwritten."""
        ...

    def on_batch(self, count: int) -> None:
        """A batch of on_data calls ended, with `count` bytes in all: wake the reads that wait. Called once
        for a batch, never for each packet."""
        ...

    def on_queued(self) -> None:
        """The reader waits for its turn, and the vehicle is not silent."""
        ...

    def on_failed(self, error: Exception) -> None:
        """The wanted bytes cannot be had: reads that wait get the error. The reader stays usable for later
        wants."""
        ...


class Reader(Protocol):
    """A remote file open for reading, as seen by the cache; survives reopening of the server's session."""

    @property
    def size(self) -> int:
        """Size in bytes by the (first) open ACK."""
        ...

    def want(self, start: int, stop: int, *, demand: bool) -> None:
        """Ask for bytes; returns at once. Wants add up, demand goes before readahead."""
        ...

    def drop(self, *, demand: bool = True) -> None:
        """Forget all wants (a read was interrupted); demand: False: those for which no program waits (after
        a seek, or a release). Bytes of requests in flight still arrive."""
        ...

    def close(self) -> None:
        """No further wants. The server session is closed lazily by the scheduler."""
        ...


class RemoteStore(Protocol):
    """The vehicle's files."""

    def why_lost(self) -> str | None:
        """Return why the vehicle counts as lost, None if it does not. It is lost if nothing was heard of it
        for 5 s, or if another vehicle answers in its place. A request that begins now would wait in vain; one
        that is under way may go on when the vehicle is back."""
        ...

    def another_client_heard(self) -> bool:
        """Return whether another FTP client was heard lately."""
        ...

    async def list_directory(self, path: bytes, *, known_end: int | None = None) -> Listing:
        """Sweep a directory that is known to be one. known_end: the `end` of its last listing.

        Raises:
            FtpNak, RequestTimeout, VehicleLost, PathTooLong.
        """
        ...

    async def open_reader(self, path: bytes, sink: ReadSink, *, expected_size: int | None = None) -> Reader:
        """Open a path that is known to be a regular file. With `expected_size` it is opened when bytes are
        wanted. The sink is called from the session's tasks until Reader.close.

        Raises:
            FtpNak, RequestTimeout, VehicleLost, SessionBusy, PathTooLong.
        """
        ...

    async def read_whole(self, path: bytes, limit: int) -> bytes:
        """Read an `@` file to its end with one constant block size, whatever size it claims.

        Raises:
            DataUnproven: longer than `limit`. Otherwise as open_reader.
        """
        ...

    async def stat_size(self, path: bytes) -> int:
        """Return a file's size by a fresh OpenFileRO + Terminate.

        Raises:
            FtpNak: with a code that errnos maps to ENOENT if there is none.
        """
        ...

    async def crc32(self, path: bytes, *, size: int | None = None) -> int:
        """Ask the vehicle for a file's CRC32 (init 0, no final xor). size: in bytes, if known: it tells how
        long the vehicle may need; the request is not repeated before.

        Raises:
            Armed: not asked in flight. FtpNak, RequestTimeout, VehicleLost. SessionBusy: another client had
            the session, so the request may be tried again later.
        """
        ...


class Upload(Protocol):
    """A remote file being written; survives reopening of the server's session."""

    @property
    def may_exist(self) -> bool:
        """Whether CreateFile may have been sent, so that the file may be there."""
        ...

    @property
    def made_twice(self) -> bool:
        """Whether CreateFile was sent more than once. Its second execution may have emptied the file while it
        was written, so the caller compares its bytes; and its size once more after the rename."""
        ...

    def wake(self) -> None:
        """The source has more."""
        ...

    async def finish(self) -> None:
        """Return when everything the source has is ACKed and Terminate is ACKed.

        It may be called again: after an error to go on where it stopped, after success if there is more.

        Raises:
            FtpNak, RequestTimeout, VehicleLost, SessionBusy, Armed. SessionLost: the session was lost again
            and again without progress. LocalProtocolError: it was ended meanwhile. Otherwise as the source.
        """
        ...

    async def end(self) -> None:
        """Let it go, finished or not, and ask the source for nothing more. If its file is open it is closed
        soon, and before its name changes. It may be called twice, and raises nothing."""
        ...


class VehicleStore(RemoteStore, Protocol):
    """The vehicle's files, and how the caches change them.

    These calls do not check types or targets; their callers do. They raise FtpNak, RequestTimeout,
    VehicleLost, SessionBusy, PathTooLong and, while armed, Armed; then the change had not happened when that
    was looked at. Only OutcomeUnknown says that it is not known: a request was not answered, and no listing
    could tell.
    """

    @property
    def traits(self) -> Traits:
        """The observed traits of the server; forgotten when it restarts."""
        ...

    @property
    def epoch(self) -> float:
        """When what was read lately last came into doubt, by the caches' clock; -inf if never.

        Proofs of before then are void. Each time is later than the one before.
        """
        ...

    def on_distrust(self, told: Callable[[], None]) -> None:
        """Call `told()` whenever the epoch was raised: the session went wrong while a file was read, or
        another FTP client was noticed, so bytes that were read lately may be another file's (promise 1)."""
        ...

    def in_doubt(self, since: float = inf) -> bool:
        """Return whether there is doubt: something in the last ten minutes, or since a time of the caches'
        clock, says that a file may have other bytes than the ACKs say. That is a late duplicate of a request,
        another FTP client, a lost session, or a restart."""
        ...

    def address(self) -> tuple[int, int]:
        """Return the vehicle's system and component id."""
        ...

    def board(self) -> str | None:
        """Return the unique id of the vehicle's board in hex, None if it did not tell one."""
        ...

    async def write_whole(
        self, path: bytes, pieces: Sequence[bytes], progress: Callable[[int], None] | None = None
    ) -> None:
        """Write an `@` file by CreateFile, WriteFile in order and one at a time, and Terminate. A piece, of
        at most 64 bytes, is sent in one request. progress: told how many bytes were ACKed.

        It is not tried again. After an error a part of it may have been carried out, and an ACK proves
        nothing.
        """
        ...

    def open_upload(self, path: bytes, source: SendBuffer) -> Upload:
        """Make a file by CreateFile and write it, in a task of its own. Sends nothing before the source has
        something, or `finish` is called. Unless the name is new, the caller waited for the end of its
        quarantine (`wait_out`).

        `path` is a temporary name, or, on cards that cannot rename, the file's own: it is free, or has the
        file that is to be replaced. An upload that was interrupted goes on by OpenFileWO where that was seen
        to keep what the file has, else all of it is sent again.
        """
        ...

    async def wait_out(self, path: bytes) -> None:
        """Wait until no late duplicate of a request can harm the next file of this name. Returns at once,
        unless duplicates were seen to come late, or this session repeated such a request
        (session.quarantine)."""
        ...

    def finishing(self) -> AbstractContextManager[None]:
        """Finish the body, which changes names, even if its caller is cancelled. Each request below that
        changes a name is finished like that once it begins.

        Raises:
            OutcomeUnknown: it was ended by `hurry`.
        """
        ...

    def hurry(self) -> None:
        """End all changes that have begun within some seconds: the process is to end."""
        ...

    async def create_empty(self, path: bytes) -> None:
        """Make an empty file, or empty it: CreateFile + Terminate."""
        ...

    async def remove(self, path: bytes, *, at_once: bool = False) -> None:
        """Remove what is known to be a file. at_once: without `wait_out`, because the name is not used again.
        A late duplicate of CreateFile could only leave an empty file there."""
        ...

    async def make_directory(self, path: bytes) -> None:
        """Make a directory."""
        ...

    async def remove_directory(self, path: bytes) -> None:
        """Remove what is known to be an empty directory."""
        ...

    async def rename(self, old: bytes, new: bytes, *, completes: bool = False) -> None:
        """Rename; both paths together must fit one request (238 bytes). completes: without this rename a name
        lacks its file, so it is done even if the vehicle was armed meanwhile."""
        ...
