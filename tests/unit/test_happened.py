"""The verdict of a listing on a change of names."""

from __future__ import annotations

import pytest

from mavftpfs.session.happened import After, Outcome, judge, together
from mavftpfs.shared.model import DirEntry, EntryKind, Listing

HAPPENED, DID_NOT, CONFLICT, UNKNOWN = Outcome


def listing(*names: bytes, complete: bool = True) -> Listing:
    """Return a listing; names that begin with D are directories."""
    kinds = {name: EntryKind.DIRECTORY if name.startswith(b"D") else EntryKind.FILE for name in names}
    return Listing(tuple(DirEntry(name, kind) for name, kind in kinds.items()), 0.0, complete)


@pytest.mark.parametrize(
    ("shown", "after", "verdict"),
    [
        (listing(b"a"), {b"a": After.ABSENT}, DID_NOT),
        (listing(b"b"), {b"a": After.ABSENT}, HAPPENED),
        (listing(b"b", complete=False), {b"a": After.ABSENT}, UNKNOWN),
        (listing(b"D"), {b"D": After.DIRECTORY}, HAPPENED),
        (listing(b"a"), {b"a": After.DIRECTORY}, CONFLICT),
        (listing(b"b"), {b"a": After.DIRECTORY}, DID_NOT),
        (listing(b"a"), {b"a": After.ABSENT, b"b": After.PRESENT}, DID_NOT),
        (listing(b"b"), {b"a": After.ABSENT, b"b": After.PRESENT}, HAPPENED),
        (listing(b"a", b"b"), {b"a": After.ABSENT, b"b": After.PRESENT}, CONFLICT),
        (listing(), {b"a": After.ABSENT, b"b": After.PRESENT}, CONFLICT),
        (listing(b"a", complete=False), {b"a": After.ABSENT, b"b": After.PRESENT}, DID_NOT),
        (listing(b"b", complete=False), {b"a": After.ABSENT, b"b": After.PRESENT}, UNKNOWN),
    ],
)
def test_verdicts(shown: Listing, after: dict[bytes, After], verdict: Outcome) -> None:
    assert together(judge(shown, name, then) for name, then in after.items()) is verdict
