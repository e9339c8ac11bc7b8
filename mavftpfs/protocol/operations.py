"""Operations that ask one thing at a time, and the page of a listing. Layer: protocol; pure.

A page's entries are NUL-terminated: `F<name>\\t<size>`, `D<name>`, `S` (skip), with opcode 16 also a third
field of decimal seconds UTC. Servers vary (servers.md 6): double NULs, files without size, bare
directories, `.` and `..`, sizes of 64 bits. The parser takes any bytes and never raises.
"""

from __future__ import annotations

from collections.abc import Callable
from math import inf
from typing import NamedTuple

from mavftpfs.protocol.payload import MAX_DATA, NakCode, Opcode, Payload
from mavftpfs.protocol.requests import RETRY_POLICIES, WORK_FLOOR, Operation, Request, nak_of
from mavftpfs.shared.errors import PathTooLong
from mavftpfs.shared.model import DirEntry, EntryKind, usable_name

BEYOND = 100_000
"""Offset of a listing that is beyond the end of any directory. No listing goes on there."""

_MAX_BARREN_PAGES = 40
"""Pages in a row without a new name: MAVSDK repeats those that come behind what it leaves out (servers.md 6).
A server that ignores the offset repeats a page for ever, and a PX4 that cannot read its card sends `S`."""

_USUAL_PACE = 0.1
"""The share of the slowest card's time that a usual card needs for a checksum. A checksum is asked for again
when a usual card would have answered, under the same seq: PX4 and ArduPilot, whose cards may be slower,
replay their answer (servers.md 2). MAVSDK computes it again, but it runs on a computer."""

_KINDS = {b"F": EntryKind.FILE, b"D": EntryKind.DIRECTORY}
_MAX_DIGITS = 20


class Simple(Operation):
    """One request, one reply.

    Args:
        session: the id to send; None sends the engine's, and asks again with the new one if it changed.
        patience: seconds until RequestTimeout, inf for the engine's deadline.
        server_time: seconds that the slowest server works at it; a repetition waits for so long.
        exclusive: see Operation.

    Attributes:
        reply: the ACK, once done without error.

    Raises:
        PathTooLong: the data does not fit a request.
    """

    def __init__(
        self,
        opcode: int,
        data: bytes = b"",
        *,
        offset: int = 0,
        session: int | None = None,
        patience: float = inf,
        server_time: float | None = None,
        exclusive: bool = False,
    ) -> None:
        if len(data) > MAX_DATA:
            raise PathTooLong(f"{len(data)} bytes do not fit the {MAX_DATA} of a request")
        self.patience = patience
        self.opcode = opcode
        self.exclusive = exclusive
        policy = RETRY_POLICIES[opcode]
        if server_time is not None:
            usual = server_time * (_USUAL_PACE if opcode == Opcode.CALC_FILE_CRC32 else 1.0)
            floor = max(policy.floor, WORK_FLOOR)
            policy = policy._replace(floor=floor, work=server_time, usual_work=usual)
        request = Request(
            self, opcode, policy, session or 0, offset, len(data), data, follows=session is None
        )
        self._requests = [request]
        self.reply: Payload

    def next_requests(self, most: int, now: float) -> list[Request]:
        """Return the one request, once, and again when it was lost."""
        requests, self._requests = self._requests, []
        return requests

    @property
    def retransmitted(self) -> bool:
        """Whether the request went out more than once, so a refusal may answer the second execution."""
        return self.sent > 1

    def on_lost(self, request: Request, now: float) -> None:
        """Have it go out again, under the same seq where an answer may still come under that."""
        keeps_seq = request.policy.same_seq and not request.stale
        self._requests = [request if keeps_seq else request.anew()]

    def on_reply(self, request: Request, reply: Payload, now: float) -> None:
        """End with the ACK or the NAK."""
        if reply.opcode == Opcode.NAK:
            self.fail(nak_of(request, reply, retransmitted=self.retransmitted))
        else:
            self.reply = reply
            self.finish()


class OpenRequest(Simple):
    """OpenFileRO, OpenFileWO or CreateFile; session: the id to ask for.

    Attributes:
        on_opened: called at once when the ACK came, before any later answer is looked at.
        session: the id that the ACK carried, to be used from then on (servers.md 14.6).
        size: as the ACK says, None where it says nothing (ArduPilot's CreateFile).
    """

    session: int
    size: int | None = None
    on_opened: Callable[[OpenRequest], None] = staticmethod(lambda operation: None)

    def on_reply(self, request: Request, reply: Payload, now: float) -> None:
        """Take session and size; learn whether the server echoes ids."""
        super().on_reply(request, reply, now)
        if self.error is not None:
            return
        self.session = reply.session
        if len(reply.data) >= 4:
            self.size = int.from_bytes(reply.data[:4], "little")
        if request.session:
            self.port.learn_session_echo(reply.session == request.session)
        self.on_opened(self)


class Page(NamedTuple):
    """The content of one page.

    strings: number of its non-empty strings, by which the next page's offset grows (servers.md 14.28).
    """

    entries: list[DirEntry]
    strings: int


def parse_page(data: bytes, *, with_time: bool = False) -> Page:
    """Return what the `data` of one listing ACK holds; never raises.

    A last string without NUL counts: a server that fills all 239 bytes may have cut the NUL only.
    """
    entries: list[DirEntry] = []
    strings = 0
    for text in data.split(b"\0"):
        if not text:
            continue
        strings += 1
        kind, (name, *fields) = _KINDS.get(text[:1]), text[1:].split(b"\t")
        # A tab in a name (MAVSDK lists those) shows as a field that is no number: it is not shown.
        understood = kind is not None and usable_name(name)
        for field in fields:
            understood = understood and field.isdigit() and len(field) <= _MAX_DIGITS
        if kind is not None and understood:
            size = int(fields[0]) if fields and kind is EntryKind.FILE else 0
            mtime = int(fields[1]) if with_time and len(fields) > 1 else 0
            entries.append(DirEntry(name, kind, size, mtime or None))
    return Page(entries, strings)


class ListDirectory(Operation):
    """A sweep of a whole directory, page by page (servers.md 6, 14.28, 14.29).

    Only for paths known to be directories: listing a file kills a MAVSDK server.

    ArduPilot and MAVSDK answer EOF at the offset of a name that fits no reply, too. So behind an EOF the next
    offset is asked for, once. If it has names, the listing goes on there, and is not complete. PX4 answers an
    empty page at such an offset. Old PX4s answer one for an empty directory, too, so an empty first page
    proves a hidden name only if another page follows.

    Attributes:
        complete: False when a cap, empty pages or a name that fits no reply hid something: absence of a name
            then proves nothing.
        strings: how many strings were received or skipped so far, which is where the next page begins.
        on_page: called for each page, where it is not None.

    known_end: the directory's `end` when it was listed before; there the next offset is not asked for.
    patience: as for Simple.
    """

    def __init__(
        self, path: bytes, with_time: bool = False, patience: float = inf, *, known_end: int | None = None
    ) -> None:
        if len(path) > MAX_DATA:
            raise PathTooLong(f"path of {len(path)} bytes does not fit the {MAX_DATA} of a request")
        self.patience = patience
        self.opcode = Opcode.LIST_DIRECTORY_WITH_TIME if with_time else Opcode.LIST_DIRECTORY
        self.complete = True
        self._eof: int | None = None  # where the server said EOF, if nothing is known to be behind
        self.strings = 0
        self.on_page: Callable[[], None] | None = None
        self._path = path
        self._with_time = with_time
        self._known_end = known_end
        self._entries: dict[bytes, DirEntry] = {}
        self._asked = -1  # the offset that was asked for last
        self._first_page = b""
        self._barren = 0  # pages in a row without a new name

    @property
    def entries(self) -> list[DirEntry]:
        """The listed entries, each name once, without `.` and `..`."""
        return list(self._entries.values())

    @property
    def end(self) -> int | None:
        """The offset at which the server said EOF, and behind which it has nothing; None if not known."""
        return self._eof if self.complete and self.error is None else None

    def next_requests(self, most: int, now: float) -> list[Request]:
        """Return the request for the next page."""
        if self._asked == self.strings:
            return []
        self._asked = self.strings
        policy, path = RETRY_POLICIES[self.opcode], self._path
        return [Request(self, self.opcode, policy, 0, self.strings, len(path), path, follows=True)]

    def on_lost(self, request: Request, now: float) -> None:
        """Ask for the page again, unless it came."""
        if request.offset == self.strings:
            self._asked = -1

    def on_reply(self, request: Request, reply: Payload, now: float) -> None:
        """Take a page, or find that there are no more."""
        if request.offset != self.strings:
            return  # the page came before, as the answer to a repetition
        if reply.opcode == Opcode.NAK:
            nak = nak_of(request, reply)
            # PX4 says 8 for everything after one "file exists" (servers.md 12), the end included.
            if nak.code == NakCode.EOF or (nak.code == NakCode.FILE_EXISTS and self.strings):
                self.progress(now)
                self._on_eof()
            else:
                self.fail(nak)
            return
        if self.on_page is not None:
            self.on_page()
        page = parse_page(reply.data, with_time=self._with_time)
        known = len(self._entries)
        for entry in page.entries:  # a page may name something twice, too
            self._entries.setdefault(entry.name, entry)
        found = len(self._entries) > known
        self._barren = 0 if found else self._barren + 1
        self.progress(now)
        if self._eof is not None:
            if not found:
                self._on_eof()
                return
            self._eof, self.complete = None, False
        if self.strings and not (page.strings and self._first_page):
            self.complete = False  # a name that fits no page lies here, or before
        # The first page again may hide others. With much room left it hides none: they would have been in it.
        again = page.entries and reply.data == self._first_page
        if page.strings:
            self._first_page = self._first_page or reply.data
        self.strings += page.strings or 1
        endless = self.strings >= BEYOND or self._barren >= _MAX_BARREN_PAGES
        if endless or (again and len(reply.data) > MAX_DATA // 2):
            self.complete = False
            self.finish()

    def _on_eof(self) -> None:
        """There is nothing at the offset: look behind it, or end."""
        if self._eof is None:
            self._eof = self.strings
            if self.strings != self._known_end:
                self.strings += 1
                return
        self.finish()
