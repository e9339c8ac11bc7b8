"""The next step for a draft, by its state and what the server was seen to do."""

from __future__ import annotations

import pytest

from mavftpfs.cache.draft import Base, Draft, Plan, State, choose
from mavftpfs.shared.errors import FileChanged, NotSupported
from mavftpfs.shared.traits import WriteTraits
from tests.unit.test_draft import Bytes

RENAMES = WriteTraits(rename_works=True)
RENAMES_NOT = WriteTraits(rename_works=False)
UNKNOWN = WriteTraits()


def draft(base: int | None, write: tuple[int, bytes] | None = None, size: int | None = None) -> Draft:
    """Return a draft over a base of so many bytes, perhaps cut, perhaps written to."""
    made = Draft(Bytes(), None if base is None else Base(base))
    if size is not None:
        made.truncate(size)
    if write is not None:
        made.write(*write)
    return made


@pytest.mark.holds("rule 14.22")
@pytest.mark.parametrize(
    ("made", "traits", "plan"),
    [
        (draft(10), UNKNOWN, Plan.NOTHING),
        (draft(None), UNKNOWN, Plan.REPLACE),
        (draft(None), RENAMES, Plan.REPLACE),
        (draft(None, (0, b"x")), RENAMES_NOT, Plan.OVERWRITE),
        (draft(10, (0, b"x"), 0), RENAMES, Plan.REPLACE),
        (draft(10, (3, b"x")), UNKNOWN, Plan.FETCH),
        (draft(10, None, 4), RENAMES, Plan.FETCH),
        (draft(10, (0, b"0123456789")), RENAMES, Plan.REPLACE),
    ],
)
def test_plans(made: Draft, traits: WriteTraits, plan: Plan) -> None:
    assert choose(made, traits, torn=False, inplace=False) is plan


def test_without_rename_nothing_is_replaced_unless_allowed() -> None:
    changed = draft(10, (0, b"x"), 0)
    with pytest.raises(NotSupported):
        choose(changed, RENAMES_NOT, torn=False, inplace=False)
    assert choose(changed, RENAMES_NOT, torn=False, inplace=True) is Plan.OVERWRITE


def test_what_was_interrupted_is_mended_first_and_what_is_stale_is_an_error() -> None:
    torn = draft(None)
    torn.state = State.TORN
    assert choose(torn, RENAMES, torn=False, inplace=False) is Plan.MEND
    torn.write(0, b"x")
    assert choose(torn, RENAMES, torn=True, inplace=False) is Plan.MEND
    assert choose(torn, RENAMES, torn=False, inplace=False) is Plan.REPLACE
    stale = draft(10)
    stale.lose_base()
    with pytest.raises(FileChanged):
        choose(stale, RENAMES, torn=False, inplace=False)
