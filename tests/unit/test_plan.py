"""Which way a draft goes, by what the server was seen to do."""

from __future__ import annotations

import pytest

from mavftpfs.cache.draft import Draft
from mavftpfs.cache.plan import Plan, Rules, choose
from mavftpfs.shared.errors import FileTooLarge, NotSupported
from mavftpfs.shared.traits import WriteTraits
from tests.unit.test_draft import Bytes

RULES = Rules(rmw_max=1000)
KEEPS = WriteTraits(wo_truncates=False)
EMPTIES = WriteTraits(wo_truncates=True)
NO_RENAME = WriteTraits(wo_truncates=True, rename_works=False)


def draft(base: int | None, *steps: tuple[int, bytes] | int) -> Draft:
    """Return a draft over `base` bytes after writes (offset, data) and truncations (size)."""
    made = Draft(Bytes(), base)
    for step in steps:
        if isinstance(step, int):
            made.truncate(step)
        else:
            made.write(*step)
    return made


@pytest.mark.parametrize(
    ("made", "traits", "plan"),
    [
        (draft(10), WriteTraits(), Plan.NOTHING),
        (draft(0, 0), WriteTraits(), Plan.NOTHING),
        (draft(None), WriteTraits(), Plan.CREATE_EMPTY),
        (draft(10, 0), WriteTraits(), Plan.CREATE_EMPTY),
        (draft(None, (0, b"x")), WriteTraits(), Plan.NEW),
        (draft(None, (5, b"x")), NO_RENAME, Plan.NEW),
        (draft(10, 0, (0, b"x")), WriteTraits(), Plan.REPLACE),
        (draft(10, 0, (0, b"x")), KEEPS, Plan.REPLACE),
        (draft(10, (10, b"x")), WriteTraits(), Plan.PROBE),
        (draft(10, (10, b"x")), KEEPS, Plan.IN_PLACE),
        (draft(10, 20), KEEPS, Plan.IN_PLACE),
        (draft(10, (3, b"x")), EMPTIES, Plan.FILL),
        (draft(10, (0, bytes(10))), EMPTIES, Plan.REPLACE),
        (draft(10, 5), WriteTraits(), Plan.TRUNCATE),
        (draft(10, 5), WriteTraits(truncate_works=False), Plan.FILL),
        (draft(10, 5, (0, b"x")), WriteTraits(), Plan.PROBE),
        (draft(10, 5, (0, b"x")), KEEPS, Plan.TRUNCATE),
        (draft(10, 5, (0, b"x")), WriteTraits(wo_truncates=False, truncate_works=False), Plan.FILL),
        (draft(10, 5, (0, b"x")), EMPTIES, Plan.FILL),
        (draft(10, 5, (0, b"12345")), KEEPS, Plan.REPLACE),
    ],
)
def test_plans(made: Draft, traits: WriteTraits, plan: Plan) -> None:
    assert choose(made, traits, RULES) is plan


def test_without_rename_nothing_is_replaced_unless_allowed() -> None:
    made = draft(10, 0, (0, b"x"))
    with pytest.raises(NotSupported):
        choose(made, NO_RENAME, RULES)
    assert choose(made, NO_RENAME, Rules(1000, inplace=True)) is Plan.REWRITE
    with pytest.raises(NotSupported):  # before the base is fetched for nothing
        choose(draft(10, (3, b"x")), NO_RENAME, RULES)


def test_a_large_file_is_not_sent_whole_for_a_part_but_is_when_it_is_all_new() -> None:
    with pytest.raises(FileTooLarge):
        choose(draft(1001, (3, b"x")), EMPTIES, RULES)
    assert choose(draft(1000, (3, b"x")), EMPTIES, RULES) is Plan.FILL
    assert choose(draft(1001, (3, b"x")), KEEPS, RULES) is Plan.IN_PLACE
    assert choose(draft(9, 0, (0, bytes(2000))), EMPTIES, RULES) is Plan.REPLACE
