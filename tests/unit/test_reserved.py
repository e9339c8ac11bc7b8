"""Reserved names: their form, where they fit, and what is done with what an interruption left."""

from __future__ import annotations

from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavftpfs.cache.repair import Action, Group, leftovers, repair
from mavftpfs.cache.reserved import (
    Kind,
    OwnNames,
    Reserved,
    fits_rename,
    is_reserved,
    new_owner,
    parse,
)
from mavftpfs.shared.errors import PathTooLong
from mavftpfs.shared.model import RENAME_ROOM, DirEntry, EntryKind, split, usable_name

names = st.binary(min_size=1, max_size=60).filter(usable_name)


@given(kind=st.sampled_from(Kind), target=st.none() | names, seed=st.integers())
def test_names_read_back(kind: Kind, target: bytes | None, seed: int) -> None:
    reserved = Reserved(new_owner(Random(seed)), kind, b"abc", target)
    assert parse(reserved.name) == reserved
    assert is_reserved(reserved.name)


@pytest.mark.parametrize(
    "name",
    [
        b"file",
        b".mavftpfs-",
        b".mavftpfs-abcdtab",
        b".mavftpfs-ABCDtabc",
        b".mavftpfs-abcdxabc",
        b"x.mavftpfs-abcdtabc",
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
        places = OwnNames(b"abcd", Random(seed)).places(path)
    except PathTooLong:
        assert above + len(path) > 218
        return
    assert places.old is not None
    for place in (places.new, places.old):
        assert fits_rename(place, path)
        assert len(place) <= 200
        assert split(place)[0] == parent
    told = parse(split(places.new)[1])
    assert told is not None
    assert told.target == (name if above + len(path) + len(name) <= 217 else None)


def test_names_do_not_repeat() -> None:
    namer = OwnNames(b"abcd", Random(5))
    assert len({namer.places(b"/a/b").new for _ in range(5000)}) == 5000


TARGET = b"/d/file"


def named(
    kind: Kind, target: bytes | None = b"file", owner: bytes = b"abcd", serial: bytes = b"sss"
) -> DirEntry:
    return DirEntry(Reserved(owner, kind, serial, target).name, EntryKind.FILE, 5)


def mended(
    kinds: list[Kind], *, target_exists: bool, target: bytes | None = b"file"
) -> list[tuple[bytes, bytes | None]]:
    """Return the kinds and what becomes of them: None = removed."""
    entries = [named(kind, target) for kind in kinds]
    (group,) = leftovers(b"/d", entries, lambda *_: True)
    kind_of = {path: kind.value for kind, path in group.paths.items()}
    return [(kind_of[action.path], action.to) for action in repair(group, target_exists=target_exists)]


def test_repair() -> None:
    assert mended([Kind.NEW], target_exists=True) == [(b"t", None)]
    assert mended([Kind.NEW, Kind.OLD], target_exists=True) == [(b"t", None), (b"o", None)]
    assert mended([Kind.OLD], target_exists=True) == [(b"o", None)]
    assert mended([Kind.NEW, Kind.OLD], target_exists=False) == [(b"t", TARGET), (b"o", None)]
    assert mended([Kind.OLD], target_exists=False) == [(b"o", TARGET)]
    assert mended([Kind.NEW], target_exists=False) == [(b"t", b"/d/recovered-tsss-file")]
    assert mended([Kind.DELETED], target_exists=True, target=None) == [(b"d", None)]


def test_repair_without_a_target_loses_no_only_copy() -> None:
    def group(*kinds: Kind) -> Group:
        return Group({kind: b"/d/" + Reserved(b"abcd", kind, b"sss").name for kind in kinds}, b"sss", None)

    assert [a.to for a in repair(group(Kind.NEW), target_exists=False)] == [None]
    assert [a.to for a in repair(group(Kind.OLD), target_exists=False)] == [b"/d/recovered-osss"]
    assert [a.to for a in repair(group(Kind.OLD, Kind.NEW), target_exists=False)] == [
        b"/d/recovered-osss",
        b"/d/recovered-tsss",
    ]


@pytest.mark.parametrize("replaces", [True, False])
@pytest.mark.parametrize("stop", range(6))
@pytest.mark.parametrize("stop_repair", range(4))
def test_a_replacement_interrupted_anywhere_and_its_repair_too(
    replaces: bool, stop: int, stop_repair: int
) -> None:
    """Whatever was done of the steps, listings and repairs end with one complete file and no litter."""
    new, old = (Reserved(b"abcd", kind, b"sss", b"file").name for kind in (Kind.NEW, Kind.OLD))
    names = {b"file": "old"}
    if stop > 0:
        names[new] = "new"
    moves = [(new, b"file")] if replaces else [(b"file", old), (new, b"file")]
    for source, target in moves[: max(0, stop - 1)]:
        names[target] = names.pop(source)
    if stop > len(moves) + 1:
        names.pop(old, None)
    for limit in (stop_repair, 9):
        entries = [DirEntry(name, EntryKind.FILE, 3) for name in names]
        for group in leftovers(b"/", entries, lambda *_: True):
            for action in repair(group, target_exists=b"file" in names)[:limit]:
                content = names.pop(action.path[1:])
                if action.to is not None:
                    names[action.to[1:]] = content
    assert list(names) == [b"file"]
    assert names[b"file"] in ("old", "new")


def test_what_is_not_ours_is_not_touched() -> None:
    entries = [
        DirEntry(b"file", EntryKind.FILE),
        DirEntry(b".mavftpfs-strange", EntryKind.FILE),
        DirEntry(named(Kind.NEW).name, EntryKind.DIRECTORY),
        DirEntry(b".mavftpfs-abcdtabc", EntryKind.DIRECTORY),
    ]
    assert leftovers(b"/d", entries, lambda *_: True) == []


def test_a_group_of_which_a_part_is_alive_is_left_alone() -> None:
    entries = [named(Kind.NEW), named(Kind.OLD), named(Kind.NEW, serial=b"zzz")]
    alive = b"/d/" + entries[1].name
    (group,) = leftovers(b"/d", entries, lambda path, owner, entry: path != alive)
    assert group.serial == b"zzz"


def test_recovered_names_fit_a_rename() -> None:
    directory = b"/" + b"d" * 40
    name = Reserved(b"abcd", Kind.NEW, b"sss", b"n" * 60).name
    (action,) = repair(
        Group({Kind.NEW: directory + b"/" + name}, b"sss", directory + b"/" + b"n" * 60), target_exists=False
    )
    assert isinstance(action, Action)
    assert action.to is not None
    assert len(action.path) + 1 + len(action.to) <= RENAME_ROOM
