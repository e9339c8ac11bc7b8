"""TemporaryName names: their form, where they fit, and what is done with what an interruption left."""

from __future__ import annotations

from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavftpfs.cache.repair import NAMELESS_FOR, SAME_FOR, due_in
from mavftpfs.cache.temporary import (
    Kind,
    TemporaryName,
    TemporaryNames,
    fits_rename,
    is_temporary,
    new_owner,
    parse,
)
from mavftpfs.shared.errors import PathTooLong
from mavftpfs.shared.model import split, usable_name

names = st.binary(min_size=1, max_size=60).filter(usable_name)


@given(kind=st.sampled_from(Kind), target=st.none() | names, seed=st.integers())
def test_names_read_back(kind: Kind, target: bytes | None, seed: int) -> None:
    temporary = TemporaryName(new_owner(Random(seed)), kind, b"abc", target)
    assert parse(temporary.name) == temporary
    assert is_temporary(temporary.name)


@pytest.mark.parametrize(
    "name",
    [
        b"file",
        b".mavftpfs-",
        b".mavftpfs-abcdnab",
        b".mavftpfs-ABCDnabc",
        b".mavftpfs-abcdxabc",
        b"x.mavftpfs-abcdnabc",
    ],
)
def test_other_names_are_not_ours(name: bytes) -> None:
    assert parse(name) is None


@given(st.lists(st.integers(1, 150), min_size=1, max_size=8), st.integers())
def test_places_fit_every_request_or_are_refused(lengths: list[int], seed: int) -> None:
    path = b"".join(b"/" + b"p" * length for length in lengths)
    parent, name = split(path)
    above = len(parent.rstrip(b"/"))
    try:
        new, old = (TemporaryNames(b"abcd", Random(seed)).need(path, kind) for kind in (Kind.NEW, Kind.OLD))
    except PathTooLong:
        assert above + len(path) > 218
        return
    for place in (new, old):
        assert fits_rename(place, path)
        assert len(place) <= 200
        assert split(place)[0] == parent
    told = parse(split(old)[1])
    assert told is not None
    assert told.target == (name if above + len(path) + len(name) <= 217 else None)


def test_names_do_not_repeat() -> None:
    namer = TemporaryNames(b"abcd", Random(5))
    assert len({namer.need(b"/a/b", Kind.NEW) for _ in range(5000)}) == 5000


@pytest.mark.parametrize(
    ("owner", "kind", "target_there", "age", "due"),
    [
        (b"ourselv", Kind.OLD, False, 0.0, True),
        (b"ourselv", Kind.NEW, False, 0.0, True),
        (b"another", Kind.OLD, False, NAMELESS_FOR - 1.0, False),
        (b"another", Kind.OLD, False, NAMELESS_FOR, True),
        (b"another", Kind.OLD, True, NAMELESS_FOR, False),
        (b"another", Kind.OLD, True, SAME_FOR, True),
        (b"another", Kind.NEW, True, SAME_FOR - 1.0, False),
        (b"four", Kind.NEW, False, SAME_FOR, True),
    ],
)
def test_when_a_temporary_name_is_repaired(
    owner: bytes, kind: Kind, target_there: bool, age: float, due: bool
) -> None:
    name = parse(TemporaryName(owner, kind, b"abc", b"file").name)
    assert name is not None
    assert (due_in(name, b"ourselv", target_there=target_there, age=age) <= 0.0) == due
