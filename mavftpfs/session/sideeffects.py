"""Requests that change the card's names: done once, or it is found out. Layer: session.

A request whose reply may have been lost can be executed twice, and the second answer is then a refusal
(servers.md 14.4). Such a refusal, and a silence, are never interpreted: a listing tells what became of it.
The network can do the same to a request that we sent once, by doubling it and losing the first answer: where
answers were seen that nobody waited for, a refusal as missing, or of a directory as being there, is looked
into as well.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from enum import Enum
from typing import TypeVar

import trio

from mavftpfs.protocol.operations import Simple
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.session.foresight import Foresight
from mavftpfs.session.scheduler import Scheduler
from mavftpfs.session.stale import StaleSessions
from mavftpfs.shared.errors import FtpNak, MavftpfsError, OutcomeUnknown, PathTooLong, RequestTimeout
from mavftpfs.shared.model import ROOT, DirEntry, EntryKind, Listing, split, wire_path

RENAME_LIMIT = 238
"""Bytes that both paths of a rename and the NUL between them may have (servers.md 9)."""

VERIFY_LIMIT = 4.0
"""Seconds to spend on finding out what became of a request that was not answered. Whoever waits was promised
an answer within `op_deadline`, and this comes after it."""

DOT = b"."
"""Lists the root on ArduPilot's SITL, with the files that "/" does not show there (servers.md 6)."""

_TAKES_AWAY = frozenset((Opcode.REMOVE_FILE, Opcode.REMOVE_DIRECTORY, Opcode.RENAME))
_MISSING = frozenset((NakCode.FAIL, NakCode.FAIL_ERRNO, NakCode.FILE_NOT_FOUND))
"""What servers say of a name that is not there (any more); the errno may be a stale one (servers.md 12)."""

_THERE = frozenset((NakCode.FAIL, NakCode.FAIL_ERRNO, NakCode.FILE_EXISTS))
_SECOND = {**dict.fromkeys(_TAKES_AWAY, _MISSING), Opcode.CREATE_DIRECTORY: _THERE}
"""What servers may say to a request that was done already, by opcode."""


def fits_rename(old: bytes, new: bytes) -> bool:
    """Return whether one request carries both paths."""
    return len(wire_path(old)) + 1 + len(wire_path(new)) <= RENAME_LIMIT


class Outcome(Enum):
    """What a listing tells about a request."""

    DONE = "done"
    UNDONE = "undone"
    CONFLICT = "conflict"
    UNKNOWN = "unknown"


E = TypeVar("E", bound=MavftpfsError)
Lister = Callable[[bytes], Awaitable[Listing]]
Verdict = Callable[[], Awaitable[Outcome]]


class SideEffects:
    """Removes, makes and renames. All methods raise FtpNak, RequestTimeout, VehicleLost, PathTooLong, Armed.

    RequestTimeout means: unknown, or known not to have happened. list_directory: sweeps a directory.
    """

    def __init__(
        self, scheduler: Scheduler, list_directory: Lister, stale: StaleSessions, foresight: Foresight
    ) -> None:
        self._scheduler = scheduler
        self._foresight = foresight
        self._stale = stale
        self._list_directory = list_directory

    async def remove(self, path: bytes) -> None:
        """Remove what is known to be a file."""
        wire = wire_path(path)
        async with self._in_time(), self._changing(path):
            await self._scheduler.echoes.let_pass(path, taken=True)
            with self._scheduler.echoes.noted(path):
                await self._perform(
                    lambda: Simple(Opcode.REMOVE_FILE, wire), lambda: self._is_absent(path), path
                )
            self._foresight.took(path)
            self._scheduler.gone(path)

    async def remove_directory(self, path: bytes) -> None:
        """Remove what is known to be an empty directory."""
        wire = wire_path(path)
        async with self._in_time(), self._changing(path, below=True):
            await self._scheduler.echoes.let_pass(path)
            with self._scheduler.echoes.noted(path):
                await self._perform(
                    lambda: Simple(Opcode.REMOVE_DIRECTORY, wire), lambda: self._is_absent(path), path
                )
            self._foresight.took(path)

    async def make_directory(self, path: bytes) -> None:
        """Make a directory."""
        wire = wire_path(path)
        async with self._in_time(), self._changing(path):
            await self._scheduler.echoes.let_pass(path)
            with self._scheduler.echoes.noted(path):
                await self._perform(
                    lambda: Simple(Opcode.CREATE_DIRECTORY, wire), lambda: self._is_new_directory(path)
                )
            self._foresight.made(path)

    async def rename(self, old: bytes, new: bytes, *, completes: bool = False) -> None:
        """Rename; who reads the old path goes on under the new one. completes: in flight, too."""
        data = wire_path(old) + b"\0" + wire_path(new)
        if not fits_rename(old, new):
            raise PathTooLong(f"both paths of a rename have {len(data)} bytes, more than {RENAME_LIMIT}")
        may = self._scheduler.require_link if completes else self._scheduler.check_may_write
        async with (
            self._in_time(),
            self._changing(old, below=True, may=may),
            self._changing(new, may=may),
        ):
            await self._scheduler.echoes.let_pass(old, taken=True)
            await self._scheduler.echoes.let_pass(new, taken=True)
            with self._scheduler.echoes.noted(old):
                await self._perform(
                    lambda: Simple(Opcode.RENAME, data), lambda: self._is_renamed(old, new), old, new
                )
            self._foresight.lose(old, new)  # there may have been a file of the new name
            self._scheduler.gone(new)
            self._scheduler.moved(old, new)

    async def perform(self, path: bytes, make: Callable[[], Simple], verify: Verdict) -> None:
        """Run another request that changes `path`; verify tells from a listing what became of it."""
        async with self._changing(path):
            await self._scheduler.echoes.let_pass(path)
            with self._scheduler.echoes.noted(path):
                await self._perform(make, verify)

    async def find(self, path: bytes) -> tuple[DirEntry | None, bool]:
        """Return a name's entry by a fresh listing of its parent, and whether the listing is complete."""
        parent, name = split(path)
        entries, complete = await self.entries(parent)
        return next((entry for entry in entries if entry.name == name), None), complete

    async def entries(self, directory: bytes) -> tuple[tuple[DirEntry, ...], bool]:
        """Return what a fresh listing shows, and whether it is complete."""
        listing = await self._list_directory(directory)
        entries = listing.entries
        if directory == ROOT and not any(entry.kind is EntryKind.FILE for entry in entries):
            # ArduPilot's SITL hides the files of the root in "/" and shows them in "." (servers.md 6).
            entries += await self._entries_of_dot()
        return entries, listing.complete

    # --- one request

    @asynccontextmanager
    async def _in_time(self) -> AsyncIterator[None]:
        """Bound the body: waiting for its turn, the request, and looking what became of it, all together."""
        with trio.move_on_after(self._scheduler.op_deadline + VERIFY_LIMIT) as scope:
            yield
        if scope.cancelled_caught:
            raise _checked(OutcomeUnknown("the vehicle did not get round to it in time"))

    @asynccontextmanager
    async def _changing(
        self, path: bytes, *, below: bool = False, may: Callable[[], None] | None = None
    ) -> AsyncIterator[None]:
        """Check that writing is allowed now (`may()` raises), and keep our own session off the path."""
        may = may or self._scheduler.check_may_write
        may()
        async with self._scheduler.claim(path, below=below):
            may()  # closing our session may have taken a while
            yield

    async def _perform(self, make: Callable[[], Simple], verify: Verdict, *taken: bytes) -> None:
        """Run a request; verify it if its answer may not be the answer to its first execution. taken: the
        names that it takes away."""
        for last in (False, True):
            try:
                with self._foresight.moving_up(*taken):
                    await self._stale.outlast(lambda: self._scheduler.metadata(make()), changes=True)
            except FtpNak as nak:
                twice = last or nak.retransmitted or self._may_be_doubled(nak)
                # PX4 says 8 to everything after one "file exists", until a listing comes to its end.
                if not twice and nak.code != NakCode.FILE_EXISTS:
                    raise
                if await self._settle(nak, verify, twice=twice, last=last):
                    return
            except RequestTimeout as silence:
                outcome = await self._after_silence(verify)
                if outcome is Outcome.DONE:
                    return
                if outcome is Outcome.UNKNOWN:
                    raise _checked(OutcomeUnknown(str(silence))) from None
                raise _checked(silence) from None
            else:
                return

    def _may_be_doubled(self, nak: FtpNak) -> bool:
        """Whether a refusal may answer the second execution of a request that was sent once.

        A rename is looked at even on a link that was not seen to double requests yet: its names were looked
        up just before, and one that is refused for nothing may count as proof that the server renames none.
        """
        opcode = Opcode(nak.opcode)
        seen = self._scheduler.stats.strays > 0 or opcode == Opcode.RENAME
        return seen and nak.code in _SECOND.get(opcode, ())

    async def _settle(self, nak: FtpNak, verify: Verdict, *, twice: bool, last: bool) -> bool:
        """Return True if the request was carried out after all, False to try it once more; else raise.

        twice: it may have been executed more than once.
        """
        outcome = await self._verdict(nak, verify)
        if outcome is Outcome.DONE and twice:
            return True
        if outcome is Outcome.UNDONE and not last:
            return False
        raise _checked(nak)

    async def _verdict(self, nak: FtpNak, verify: Verdict) -> Outcome:
        try:
            return await verify()
        except FtpNak:
            raise _checked(nak) from None  # there is not even a parent to list
        except RequestTimeout as silence:
            raise _checked(OutcomeUnknown(f"{nak}; whether it was done is not known")) from silence

    async def _after_silence(self, verify: Verdict) -> Outcome:
        with trio.move_on_after(VERIFY_LIMIT):
            try:
                return await verify()
            except MavftpfsError:
                return Outcome.UNKNOWN
        return Outcome.UNKNOWN

    # --- what listings tell

    async def _is_absent(self, path: bytes) -> Outcome:
        entry, complete = await self.find(path)
        if entry is not None:
            return Outcome.UNDONE
        return Outcome.DONE if complete else Outcome.UNKNOWN

    async def _is_new_directory(self, path: bytes) -> Outcome:
        """A directory that is there and empty may be the one we made; with entries it is somebody else's."""
        entry, complete = await self.find(path)
        if entry is None:
            return Outcome.UNDONE if complete else Outcome.UNKNOWN
        if entry.kind is not EntryKind.DIRECTORY:
            return Outcome.CONFLICT
        listing = await self._list_directory(path)
        return Outcome.CONFLICT if listing.entries else Outcome.DONE

    async def _is_renamed(self, old: bytes, new: bytes) -> Outcome:
        old_entry, complete = await self.find(old)
        new_entry, new_complete = await self.find(new)
        if old_entry is not None:
            return Outcome.CONFLICT if new_entry is not None else Outcome.UNDONE
        if new_entry is not None and complete:
            return Outcome.DONE
        return Outcome.CONFLICT if complete and new_complete else Outcome.UNKNOWN

    async def _entries_of_dot(self) -> tuple[DirEntry, ...]:
        try:
            return (await self._list_directory(DOT)).entries
        except FtpNak:
            return ()


def _checked(error: E) -> E:
    """Return an error that says that nobody needs to look again."""
    error.checked = True
    return error
