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
"""Offset of a listing that is beyond the end of any directory."""

MAX_ENTRIES = 100_000
MAX_PAGES = 60_000
_MAX_EMPTY_PAGES = 4
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
    empty page at such an offset; if names follow, the listing is not complete, either.

    Attributes:
        entries: what was listed, each name once, `.` and `..` left out.
        complete: False when a cap, empty pages or a name that fits no reply hid something: absence of a name
            then proves nothing.
        end: the offset at which the server said EOF, and behind which it has nothing; None if not known.
        strings: how many strings were received so far, which is where the next page begins.
        on_page: called for each page, where it is not None.

    known_end: the directory's `end` when it was listed before; there the next offset is not asked for.
    patience: as for Simple.
    """

    def __init__(
        self, path: bytes, with_time: bool = False, patience: float = inf, *, known_end: int | None = None
    ) -> None:
        self.patience = patience
        self.end: int | None = None
        self._known_end = known_end
        self._beyond = False  # the offset behind an EOF was asked for
        if len(path) > MAX_DATA:
            raise PathTooLong(f"path of {len(path)} bytes does not fit the {MAX_DATA} of a request")
        self.entries: list[DirEntry] = []
        self.complete = True
        self.on_page: Callable[[], None] | None = None
        self._path = path
        self._with_time = with_time
        self.opcode = Opcode.LIST_DIRECTORY_WITH_TIME if with_time else Opcode.LIST_DIRECTORY
        self._names: set[bytes] = set()
        self.strings = 0
        self._asked = False
        self._pages = 0
        self._first_page = b""
        self._first_page_again = False
        self._empty_pages = 0

    def next_requests(self, most: int, now: float) -> list[Request]:
        """Return the request for the next page."""
        if self._asked:
            return []
        self._asked = True
        policy, path = RETRY_POLICIES[self.opcode], self._path
        return [Request(self, self.opcode, policy, 0, self.strings, len(path), path, follows=True)]

    def on_lost(self, request: Request, now: float) -> None:
        """Ask for the page again, unless it came."""
        if request.offset == self.strings:
            self._asked = False

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
        self._asked = False
        self._pages += 1
        if self.on_page is not None:
            self.on_page()
        page = parse_page(reply.data, with_time=self._with_time)
        if self._beyond:
            if not any(entry.name not in self._names for entry in page.entries):
                self._on_eof()
                return
            self._beyond = self.complete = False
        if page.strings == 0:
            self.progress(now)
            self._on_empty_page()
            return
        if self._empty_pages and page.entries:
            self.complete = False  # a name that fits no page lies before these
        self._empty_pages = 0
        if self.strings == 0:
            self._first_page = reply.data
        elif page.entries and reply.data == self._first_page and self._ignores_offset():
            self.complete = False
            self.finish()
            return
        self.strings += page.strings
        known = len(self._names)
        for entry in page.entries:  # a page may name something twice, too
            if entry.name not in self._names:
                self._names.add(entry.name)
                self.entries.append(entry)
        # MAVSDK repeats entries where it left some out; a server that ignores the offset never stops.
        if len(self._names) > known or not page.entries:
            self.progress(now)
        if self._pages >= MAX_PAGES or len(self.entries) >= MAX_ENTRIES:
            self.complete = False
            self.finish()

    def _on_eof(self) -> None:
        """There is nothing at the offset: look behind it, or end."""
        if not self._beyond and self.strings != self._known_end:
            self.strings += 1
            self._beyond, self._asked = True, False
            return
        self.end = self.strings - self._beyond if self.complete else None
        self.finish()

    def _ignores_offset(self) -> bool:
        """Return whether the server sends its first page for ever, now that the page came again.

        MAVSDK repeats a first page, too, where it leaves out more entries than it shows (servers.md 6). But
        such a page has much room left, and comes only twice.
        """
        again, self._first_page_again = self._first_page_again, True
        return again or len(self._first_page) > MAX_DATA // 2

    def _on_empty_page(self) -> None:
        # Old PX4 ends so; newer ones when an entry fits no page, and offset + 1 gets past it.
        self._empty_pages += 1
        self.strings += 1
        if self._empty_pages >= _MAX_EMPTY_PAGES:
            # So many names in a row that fit no page look like the end, too: more may come behind them.
            self.complete = self._pages == self._empty_pages
            self.finish()
