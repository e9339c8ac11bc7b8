"""Operations that ask one thing at a time; listing pages of every server, and of none."""

from __future__ import annotations

import random

import pytest

from mavftpfs.protocol.engine import Engine
from mavftpfs.protocol.flow import Flow
from mavftpfs.protocol.operations import (
    BEYOND,
    ListDirectory,
    OpenRequest,
    Simple,
    parse_page,
)
from mavftpfs.protocol.payload import NakCode, Opcode, Payload
from mavftpfs.protocol.requests import Operation
from mavftpfs.shared.errors import FtpNak, PathTooLong
from mavftpfs.shared.model import DirEntry, EntryKind
from tests.support.replies import ack, nak, sent


def begin(op: Operation) -> tuple[Engine, Payload]:
    engine = Engine(random.Random(1), Flow())
    engine.start(op, 0.0)
    (request,) = sent(engine, 0.0)
    return engine, request


# --- Simple, OpenRequest, Terminate


@pytest.mark.parametrize(
    ("codes", "code", "errno"),
    [
        ((1,), 1, None),
        ((2, 28), 2, 28),
        ((2,), 2, None),
        ((10, 7), 10, None),
        ((), 0, None),
        ((201,), 201, None),
    ],
)
def test_refusals(codes: tuple[int, ...], code: int, errno: int | None) -> None:
    op = Simple(Opcode.REMOVE_FILE, b"/f")
    engine, request = begin(op)
    engine.receive(nak(request, *codes), 0.1)
    error = op.error
    assert isinstance(error, FtpNak)
    assert (error.opcode, error.code, error.server_errno, error.retransmitted) == (8, code, errno, False)


@pytest.mark.holds("rule 14.33")
def test_too_long_data_is_refused_before_a_byte_is_sent() -> None:
    with pytest.raises(PathTooLong):
        Simple(Opcode.RENAME, bytes(240))
    with pytest.raises(PathTooLong):
        ListDirectory(bytes(240))


@pytest.mark.parametrize("data", [b"", b"\1\2\3"])
def test_an_open_ack_may_say_no_size(data: bytes) -> None:
    op = OpenRequest(Opcode.CREATE_FILE, b"/f", session=9)
    engine, request = begin(op)
    engine.receive(ack(request, data), 0.1)
    assert op.size is None
    assert op.session == 9


@pytest.mark.holds("rule 14.6")
def test_an_open_with_session_0_proves_nothing() -> None:
    op = OpenRequest(Opcode.OPEN_FILE_RO, b"/f", session=0)
    engine, request = begin(op)
    engine.receive(ack(request, bytes(4)), 0.1)
    assert engine.traits.ack_carries_own_session is None


@pytest.mark.holds("rule 14.11")
def test_a_failed_close_is_an_error() -> None:
    op = Simple(Opcode.TERMINATE_SESSION, session=4)
    engine, request = begin(op)
    engine.receive(nak(request, NakCode.FAIL_ERRNO, 28), 0.1)
    assert isinstance(op.error, FtpNak)


# --- a page of a listing

F, D = EntryKind.FILE, EntryKind.DIRECTORY


@pytest.mark.parametrize(
    ("data", "entries"),
    [
        (b"", []),
        (b"Fa.txt\t12\0", [DirEntry(b"a.txt", F, 12)]),
        (b"Fa.txt\t12", [DirEntry(b"a.txt", F, 12)]),
        (b"Fa\0", [DirEntry(b"a", F, 0)]),
        (b"Dsub\0", [DirEntry(b"sub", D)]),
        (b"Dsub\t4096\0", [DirEntry(b"sub", D)]),
        (b"Fa\t1\0\0Db\0\0", [DirEntry(b"a", F, 1), DirEntry(b"b", D)]),
        (b"F\xff\xfe \xc3\xa4\t0\0", [DirEntry(b"\xff\xfe \xc3\xa4", F, 0)]),
        (b"Fbig\t12345678901\0", [DirEntry(b"big", F, 12345678901)]),
        (b"Fa\t5\t1700000000\0", [DirEntry(b"a", F, 5)]),
    ],
)
def test_forms(data: bytes, entries: list[DirEntry]) -> None:
    page = parse_page(data)
    assert page.entries == entries


@pytest.mark.parametrize(
    ("data", "entries"),
    [
        (b"Fa\t5\t1700000000\0", [DirEntry(b"a", F, 5, 1700000000)]),
        (b"Fa\t5\t0\0", [DirEntry(b"a", F, 5, None)]),
        (b"Fa\t5\0", [DirEntry(b"a", F, 5, None)]),
        (b"Dd\t0\t1700000001\0", [DirEntry(b"d", D, 0, 1700000001)]),
        (b"Dd\0", [DirEntry(b"d", D)]),
        (b"Fa\t5\t17\t9\0", [DirEntry(b"a", F, 5, 17)]),
    ],
)
def test_forms_with_time(data: bytes, entries: list[DirEntry]) -> None:
    assert parse_page(data, with_time=True).entries == entries


@pytest.mark.holds("fault odd listing")
def test_strings_count_but_empty_ones_do_not_and_dots_are_left_out() -> None:
    page = parse_page(b"S\0S\0\0Fa\t1\0\0X?\0Dd\0D.\0F..\t1\0")
    assert page.strings == 7
    assert [entry.name for entry in page.entries] == [b"a", b"d"]


@pytest.mark.parametrize(
    "text",
    [
        b"Fa/b\t1",
        b"F\t1",
        b"D",
        b"Fa\tb\t1",
        b"Da\tb",
        b"Fa\t-1",
        b"Fa\tx",
        b"Fa\t" + b"9" * 21,
        b"Fa\t",
        b"?",
    ],
)
def test_unusable_names_are_hidden(text: bytes) -> None:
    page = parse_page(text + b"\0Fok\t1\0")
    assert page.entries == [DirEntry(b"ok", F, 1)]
    assert page.strings == 2


# --- ListDirectory


class Lister:
    """Answers the pages of one sweep."""

    def __init__(self, known_end: int | None = None) -> None:
        self.op = ListDirectory(b"/d", known_end=known_end)
        self.engine = Engine(random.Random(1), Flow())
        self.engine.start(self.op, 0.0)
        self.offsets: list[int] = []

    def ask(self) -> Payload:
        (request,) = sent(self.engine, 0.0)
        assert request.data == b"/d"
        self.offsets.append(request.offset)
        return request

    def page(self, data: bytes, *, offset: int | None = None) -> None:
        self.engine.receive(ack(self.ask(), data, offset=offset), 0.0)

    def end(self, *codes: int) -> None:
        self.engine.receive(nak(self.ask(), *codes), 0.0)

    @property
    def names(self) -> list[bytes]:
        return [entry.name for entry in self.op.entries]


@pytest.mark.holds("rule 14.28")
def test_pages_are_counted_by_their_non_empty_strings() -> None:
    lister = Lister()
    lister.page(b"S\0S\0Fa\t1\0\0Db\0\0")
    lister.page(b"Fc\t3", offset=0)
    lister.end(NakCode.EOF)
    lister.end(NakCode.EOF)
    assert lister.offsets == [0, 4, 5, 6]
    assert lister.op.end == 5
    assert lister.op.entries == [
        DirEntry(b"a", EntryKind.FILE, 1),
        DirEntry(b"b", EntryKind.DIRECTORY),
        DirEntry(b"c", EntryKind.FILE, 3),
    ]
    assert lister.op.complete
    assert lister.op.done
    assert lister.op.error is None


@pytest.mark.holds("fault odd listing")
def test_repeats_and_bad_names_are_dropped() -> None:
    lister = Lister()
    lister.page(b"Fa\t1\0Fa\t1\0Fx/y\t1\0D.\0")
    lister.page(b"Fa\t1\0Fb\t1\0")
    lister.end(NakCode.EOF)
    lister.end(NakCode.EOF)
    assert lister.names == [b"a", b"b"]
    assert lister.offsets == [0, 4, 6, 7]


@pytest.mark.holds("rule 14.29")
def test_eight_ends_a_sweep_only_behind_a_page() -> None:
    lister = Lister()
    lister.page(b"Fa\t1\0")
    lister.end(NakCode.FILE_EXISTS)
    lister.end(NakCode.FILE_EXISTS)
    assert lister.op.done
    assert lister.op.error is None
    lister = Lister()
    lister.end(NakCode.FILE_EXISTS)
    assert isinstance(lister.op.error, FtpNak)


@pytest.mark.holds("fault odd listing", "rule 14.29")
@pytest.mark.parametrize("first", [b"Fa\t1\0", b"S\0S\0", b""])
def test_names_behind_entries_that_fit_no_page_are_listed(first: bytes) -> None:
    lister = Lister()
    lister.page(first)
    for _ in range(6):
        lister.page(b"")
    lister.page(b"Fb\t1\0")
    for _ in range(2):
        lister.end(NakCode.EOF)
    assert b"b" in lister.names
    assert lister.op.done
    assert not lister.op.complete


@pytest.mark.holds("fault odd listing", "rule 14.29")
@pytest.mark.parametrize(
    ("pages", "complete"),
    [([b"Fa\t1\0", b""], False), ([b"S\0", b""], False), ([b""], True), ([b"", b""], False)],
)
def test_an_empty_page_hides_a_name(pages: list[bytes], complete: bool) -> None:
    """An old PX4 answers one for an empty directory, and only at its beginning."""
    lister = Lister()
    for page in pages:
        lister.page(page)
    for _ in range(2):
        lister.end(NakCode.EOF)
    assert lister.op.done
    assert lister.op.complete is complete


@pytest.mark.holds("fault odd listing", "promise 10")
def test_names_behind_an_early_eof_are_shown_and_prove_that_the_listing_is_not_complete() -> None:
    lister = Lister()
    lister.page(b"Fa\t1\0")
    lister.end(NakCode.EOF)  # a name is here that fits no reply
    lister.page(b"Fb\t1\0Fc\t1\0")
    lister.end(NakCode.EOF)  # another one
    lister.page(b"Fd\t1\0")
    for _ in range(2):
        lister.end(NakCode.EOF)
    assert lister.offsets == [0, 1, 2, 4, 5, 6, 7]
    assert lister.names == [b"a", b"b", b"c", b"d"]
    assert lister.op.done
    assert not lister.op.complete
    assert lister.op.end is None


@pytest.mark.holds("fault odd listing")
@pytest.mark.parametrize("again", [b"", b"Fa\t1\0", b"S\0"])
def test_an_old_name_or_none_behind_the_end_proves_nothing(again: bytes) -> None:
    lister = Lister()
    lister.page(b"Fa\t1\0")
    lister.end(NakCode.EOF)
    lister.page(again)
    assert lister.op.done
    assert lister.op.complete
    assert lister.op.end == 1


@pytest.mark.holds("rule 14.29")
@pytest.mark.parametrize("code", [(NakCode.INVALID_SESSION,), (NakCode.FAIL_ERRNO, 5)])
def test_another_refusal_behind_the_end_proves_no_end(code: tuple[int, ...]) -> None:
    lister = Lister()
    lister.page(b"Fa\t1\0")
    lister.end(NakCode.EOF)
    lister.end(*code)
    assert isinstance(lister.op.error, FtpNak)
    assert lister.op.end is None


def test_behind_a_known_end_nothing_is_asked_for() -> None:
    lister = Lister(known_end=1)
    lister.page(b"Fa\t1\0")
    lister.end(NakCode.EOF)
    assert lister.offsets == [0, 1]
    assert (lister.op.done, lister.op.complete, lister.op.end) == (True, True, 1)
    lister = Lister(known_end=2)
    lister.page(b"Fa\t1\0")
    lister.end(NakCode.EOF)
    assert not lister.op.done, "the number of its names changed"


@pytest.mark.holds("rule 14.29")
def test_a_server_that_ignores_the_offset_is_left() -> None:
    lister = Lister()
    while not lister.op.done:
        lister.page(b"Fa\t1\0Fb\t1\0")
    assert not lister.op.complete
    assert lister.names == [b"a", b"b"]
    assert lister.engine.stats.requests < 50


@pytest.mark.holds("fault odd listing")
@pytest.mark.parametrize("hidden", [1, 2, 7, 30])
def test_a_server_that_counts_what_it_leaves_out_is_listed_to_its_end(hidden: int) -> None:
    """MAVSDK leaves out sockets and the like; here they come first in the directory."""
    lister = Lister()
    shown = [b"Fa\t1\0", b"Fb\t1\0"]
    while not lister.op.done:
        request = lister.ask()
        page = b"".join(shown[max(0, request.offset - hidden) :])
        reply = ack(request, page) if page else nak(request, NakCode.EOF)
        lister.engine.receive(reply, 0.0)
    assert lister.names == [b"a", b"b"]
    assert lister.op.complete
    assert lister.op.end is not None


@pytest.mark.parametrize("page", [b"S\0", b"S\0" * 119, b""])
def test_endless_pages_without_names_end(page: bytes) -> None:
    """A PX4 before 2025 whose card cannot be read answers `S` at each offset."""
    lister = Lister()
    while not lister.op.done:
        lister.page(page)
    assert not lister.op.complete
    assert lister.engine.stats.requests < 50


@pytest.mark.holds("promise 8", "rule 14.29")
def test_a_million_entries_end() -> None:
    lister = Lister()
    count = 0
    while not lister.op.done:
        lister.page(b"".join(b"F%d\0" % (count + index) for index in range(25)))
        count += 25
    assert not lister.op.complete
    assert len(lister.op.entries) == BEYOND
