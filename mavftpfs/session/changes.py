"""Did that change happen? Requests that change the card's names, done once or found out. Layer: session.

A request whose answer may have been lost can be carried out twice, and the second answer is then a refusal
(docs/servers.md 14.4). Such a refusal, and a silence, are never interpreted: a listing tells what became of
it. While there is doubt (session.doubt) the network may do the same to a request that we sent once. Then a
name is not changed twice within the time by which requests were seen to be late, either: the same request,
carried out late once more, would change what has the name by then.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager, suppress
from enum import Enum
from functools import partial
from math import inf

import trio

from mavftpfs.protocol.operations import Simple
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.session.doubt import MOST_LATE
from mavftpfs.session.scheduler import Scheduler
from mavftpfs.session.vehicle import Vehicle
from mavftpfs.shared.errors import FtpNak, MavftpfsError, OutcomeUnknown, PathTooLong, RequestTimeout
from mavftpfs.shared.model import DOT, DirEntry, EntryKind, Listing, hides_files, split, wire_path

RENAME_LIMIT = 238
"""Bytes that both paths of a rename and the NUL between them may have (docs/servers.md 9)."""

VERIFY_LIMIT = 4.0
"""Seconds to spend on finding out what became of a request that was not answered. Whoever waits was promised
an answer within `op_deadline`, and this comes after it."""

SWEEPS = 3
"""How often a directory is listed at most because names of it changed meanwhile."""

COPY_RATE = 100_000.0
"""Bytes per second that the slowest card checksums; the question is not repeated before."""

_MISSING = frozenset((NakCode.FAIL, NakCode.FAIL_ERRNO, NakCode.FILE_NOT_FOUND))
"""What servers say of a name that is not there (any more); the errno may be a stale one (docs/servers.md 12).
"""

_THERE = frozenset((NakCode.FAIL, NakCode.FAIL_ERRNO, NakCode.FILE_EXISTS))
_SECOND = {
    Opcode.REMOVE_FILE: _MISSING,
    Opcode.REMOVE_DIRECTORY: _MISSING,
    Opcode.RENAME: _MISSING,
    Opcode.CREATE_DIRECTORY: _THERE,
}
"""What servers may say to a request that was done already, by opcode."""


class Outcome(Enum):
    """What a listing tells about a request."""

    DONE = "done"
    UNDONE = "undone"
    CONFLICT = "conflict"
    UNKNOWN = "unknown"


Lister = Callable[[bytes], Awaitable[Listing]]
Verdict = Callable[[], Awaitable[Outcome]]


class Changes:
    """Removes, makes, renames and empties. list_directory: sweeps a directory.

    All methods raise FtpNak, RequestTimeout, VehicleLost, SessionBusy, PathTooLong, Armed: it did not happen;
    or OutcomeUnknown: nobody knows. Only create_empty looks at no listing: after its RequestTimeout the file
    may be there, and empty.
    """

    def __init__(
        self, scheduler: Scheduler, vehicle: Vehicle, list_directory: Lister, clock: Callable[[], float]
    ) -> None:
        self._scheduler = scheduler
        self._vehicle = vehicle
        self._list_directory = list_directory
        self._clock = clock
        self._sent = 0
        self._under_way = 0
        self._changed_at: dict[bytes, float] = {}

    async def remove(self, path: bytes) -> None:
        """Remove what is known to be a file."""
        request = partial(Simple, Opcode.REMOVE_FILE, wire_path(path))
        async with self._changing(path):
            await self._perform(request, partial(self._is_absent, path))
            self._scheduler.on_removed(path)

    async def remove_directory(self, path: bytes) -> None:
        """Remove what is known to be an empty directory."""
        request = partial(Simple, Opcode.REMOVE_DIRECTORY, wire_path(path))
        async with self._changing(path, below=True):
            await self._perform(request, partial(self._is_absent, path))

    async def make_directory(self, path: bytes) -> None:
        """Make a directory."""
        request = partial(Simple, Opcode.CREATE_DIRECTORY, wire_path(path))
        async with self._changing(path):
            await self._perform(request, partial(self._is_new_directory, path))

    async def rename(self, old: bytes, new: bytes, *, completes: bool = False) -> None:
        """Rename; who reads the old path goes on under the new one. completes: in flight, too."""
        data = wire_path(old) + b"\0" + wire_path(new)
        if len(data) > RENAME_LIMIT:
            raise PathTooLong(f"both paths of a rename have {len(data)} bytes, more than {RENAME_LIMIT}")
        async with self._changing(old, new, below=True, in_flight=completes):
            await self._perform(partial(Simple, Opcode.RENAME, data), partial(self._is_renamed, old, new))
            self._scheduler.on_renamed(old, new)

    async def create_empty(self, path: bytes) -> None:
        """Make an empty file, or empty it; done twice it is the same."""
        wire_path(path)
        self._vehicle.require_writable(self._clock())
        await self.rest(path)
        try:
            await self._scheduler.use_session(path, Opcode.CREATE_FILE)
        finally:
            self._note_changed(path)

    async def rest(self, path: bytes) -> None:
        """Wait while a late copy of the last change of this name may yet be carried out.

        Names that differ by case alone count as one, as on many cards.
        """
        until = self._changed_at.get(path.lower(), -inf) + self._scheduler.doubt.lateness
        await trio.sleep(max(0.0, until - self._clock()))

    # --- one change

    @asynccontextmanager
    async def _changing(
        self, *paths: bytes, below: bool = False, in_flight: bool = False
    ) -> AsyncIterator[None]:
        """Check that writing is allowed now, and keep our own session off the paths.

        below: also off all that lies below the first. in_flight: armed or not.
        """
        require = self._vehicle.require_there if in_flight else self._vehicle.require_writable
        require(self._clock())
        with trio.move_on_after(self._scheduler.op_deadline + VERIFY_LIMIT) as scope:
            async with self._scheduler.server.excluded(*paths, below=below):
                for path in paths:
                    await self.rest(path)
                require(self._clock())  # closing our session may have taken a while
                try:
                    yield
                finally:
                    for path in paths:
                        self._note_changed(path)
        if scope.cancelled_caught:
            raise OutcomeUnknown("the vehicle did not get round to it in time")

    def _note_changed(self, path: bytes) -> None:
        now = self._clock()
        while self._changed_at and now - next(iter(self._changed_at.values())) > MOST_LATE:
            del self._changed_at[next(iter(self._changed_at))]
        self._changed_at.pop(path.lower(), None)
        self._changed_at[path.lower()] = now  # the oldest are in front

    async def _perform(self, make: Callable[[], Simple], verify: Verdict) -> None:
        """Run a request; look what became of it if its answer may not be that to its first execution."""
        server = self._scheduler.server
        for last in (False, True):
            try:
                await server.retry_while_taken(partial(self._send, make), changes=True)
                return
            except FtpNak as nak:
                twice = last or self._may_be_second(nak)
                # PX4 says 8 to everything after one "file exists", until a listing comes to its end.
                if not twice and nak.code != NakCode.FILE_EXISTS:
                    raise
                outcome = await self._after_refusal(nak, verify)
                if outcome is Outcome.DONE and twice:
                    return
                if outcome is not Outcome.UNDONE or last:
                    raise
            except RequestTimeout as silence:
                outcome = await self._after_silence(verify)
                if outcome is Outcome.DONE:
                    return
                if outcome is Outcome.UNDONE:
                    raise
                raise OutcomeUnknown(str(silence)) from silence

    async def _send(self, make: Callable[[], Simple]) -> None:
        self._under_way += 1
        self._sent += 1
        try:
            await self._scheduler.metadata(make())
        finally:
            self._under_way -= 1

    def _may_be_second(self, nak: FtpNak) -> bool:
        """Whether a refusal may answer the second execution of a request.

        A rename is looked at in any case: its names were looked up just before, and one that is refused for
        nothing would count as proof that the server renames none.
        """
        if nak.retransmitted:
            return True
        opcode = Opcode(nak.opcode)
        looked_at = self._scheduler.doubt.is_active() or opcode == Opcode.RENAME
        return looked_at and nak.code in _SECOND.get(opcode, ())

    async def _after_refusal(self, nak: FtpNak, verify: Verdict) -> Outcome:
        try:
            outcome = await verify()
        except FtpNak:
            raise nak from None  # there is not even a parent to list
        except MavftpfsError as error:
            raise OutcomeUnknown(f"{nak}; whether it was done is not known") from error
        if outcome is Outcome.UNKNOWN:
            raise OutcomeUnknown(f"{nak}; whether it was done is not known") from nak
        return outcome

    async def _after_silence(self, verify: Verdict) -> Outcome:
        with trio.move_on_after(VERIFY_LIMIT):
            try:
                return await verify()
            except MavftpfsError:
                return Outcome.UNKNOWN
        return Outcome.UNKNOWN

    # --- what listings tell

    async def _find(self, path: bytes) -> tuple[DirEntry | None, bool]:
        """Return a name's entry by a fresh listing of its parent, and whether the listing is complete."""
        parent, name = split(path)
        entries, complete = await self._entries(parent)
        return next((entry for entry in entries if entry.name == name), None), complete

    async def _entries(self, directory: bytes) -> tuple[tuple[DirEntry, ...], bool]:
        """Return what a fresh listing shows, and whether it is complete."""
        entries, complete = await self._steady(directory)
        if hides_files(directory, entries):
            with suppress(FtpNak):
                entries += (await self._steady(DOT))[0]
        return entries, complete

    async def _steady(self, directory: bytes) -> tuple[tuple[DirEntry, ...], bool]:
        """List; again if changes of ours went on meanwhile. Servers count names: those behind one that is
        taken away move up, past the place where a sweep goes on. If they never stood still: what any saw."""
        seen: dict[bytes, DirEntry] = {}
        listing = None
        for _ in range(SWEEPS):
            before = self._sent
            listing = await self._list_directory(directory)
            seen |= {entry.name: entry for entry in listing.entries}
            if self._sent == before and not self._under_way:
                return listing.entries, listing.complete
        return tuple(seen.values()), listing is not None and listing.complete

    async def _is_absent(self, path: bytes) -> Outcome:
        entry, complete = await self._find(path)
        if entry is not None:
            return Outcome.UNDONE
        return Outcome.DONE if complete else Outcome.UNKNOWN

    async def _is_new_directory(self, path: bytes) -> Outcome:
        """A directory that is there and empty may be the one we made; with entries it is somebody else's."""
        entry, complete = await self._find(path)
        if entry is None:
            return Outcome.UNDONE if complete else Outcome.UNKNOWN
        if entry.kind is not EntryKind.DIRECTORY:
            return Outcome.CONFLICT
        listing = await self._list_directory(path)
        return Outcome.CONFLICT if listing.entries else Outcome.DONE

    async def _is_renamed(self, old: bytes, new: bytes) -> Outcome:
        (parent, old_name), (target, new_name) = split(old), split(new)
        entries, complete = await self._entries(parent)
        others, new_complete = (entries, complete) if target == parent else await self._entries(target)
        old_entry = next((entry for entry in entries if entry.name == old_name), None)
        new_entry = next((entry for entry in others if entry.name == new_name), None)
        if old_entry is not None:
            return Outcome.CONFLICT if new_entry is not None else Outcome.UNDONE
        if new_entry is not None and complete:
            return Outcome.DONE
        return Outcome.CONFLICT if complete and new_complete else Outcome.UNKNOWN
