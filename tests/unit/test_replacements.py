"""The record of a replacement that is not finished: what it says of the name."""

from __future__ import annotations

import pytest

from mavftpfs.cache.replacements import Replacement, Replacements

FILE, ASIDE = b"/d/f", b"/d/.aside"


@pytest.mark.parametrize(
    ("aside", "placed", "is_unfinished", "lacks_file"),
    [
        (None, None, True, False),
        (ASIDE, None, True, True),
        (ASIDE, False, True, True),
        (ASIDE, True, False, False),
    ],
)
def test_what_is_known_of_a_name(
    aside: bytes | None, placed: bool | None, is_unfinished: bool, lacks_file: bool
) -> None:
    replacements = Replacements()
    assert not replacements.is_unfinished(FILE)
    replacements.put(FILE, Replacement(aside, placed))
    assert replacements.is_unfinished(FILE) == is_unfinished
    assert replacements.needed_asides() == ({aside} if lacks_file else set())


@pytest.mark.parametrize(("placed", "then"), [(None, None), (False, False), (True, None)])
def test_that_the_new_file_is_not_there_stays_known(placed: bool | None, then: bool | None) -> None:
    replacements = Replacements()
    replacements.put(FILE, Replacement(ASIDE, placed, until=7.0))
    replacements.on_interrupted(FILE)
    record = replacements.end(FILE)
    assert record is not None
    assert (record.aside, record.placed) == (ASIDE, then)
    assert not replacements


def test_records_follow_the_directory() -> None:
    replacements = Replacements()
    replacements.put(FILE, Replacement(ASIDE, placed=False))
    replacements.follow_rename(b"/d", b"/e")
    assert replacements.get(FILE) is None
    assert replacements.get(b"/e/f") == Replacement(b"/e/.aside", placed=False)
