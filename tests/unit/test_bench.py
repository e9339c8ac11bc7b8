"""What the bench takes for the limit of a link, and the page that shows what it recorded."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.bench import record, tables
from tests.bench.cases import Case

PROJECT = Path(__file__).parents[2]


def test_a_card_that_pauses_costs_where_nothing_bridges_it() -> None:
    """A request takes 0.5 ms and every 500th pauses for 175 ms on average."""
    link, always_busy = 100_000 * 239 / 266, 239 / 0.00085
    assert Case("px4-nuttx", 1e6, 0.1, 0.0, "read").limit == pytest.approx(always_busy, rel=0.001)
    assert Case("px4-nuttx", 1e6, 0.1, 0.0, "write").limit == pytest.approx(always_busy)
    assert Case("px4-nuttx", 1e5, 0.1, 0.0, "read").limit == pytest.approx(link, rel=0.001), (
        "answers wait in the link"
    )
    write = Case("px4-nuttx", 1e5, 0.1, 0.0, "write")
    assert 239 / (0.00266 + 0.00035) < write.limit < link, "five writes wait, the others are lost"
    assert write.limit_beside([0.0007]) < write.limit < write.limit_beside([0.0])
    assert Case("px4", 1e5, 0.1, 0.0, "write").limit_beside([0.0]) == pytest.approx(link)


def test_the_page_shows_what_was_recorded() -> None:
    page = (PROJECT / "docs/benchmarks.md").read_text()
    recorded = record.sections(record.RESULTS)
    assert tables.filled_in(page, recorded) == page, "scripts/bench plots --page docs/benchmarks.md"
    (picture,) = re.findall(r"\]\(\.\./(tests/bench/\S+\.svg)\)", page)
    assert (PROJECT / picture).is_file()
    for section in recorded.values():
        assert f"`{' '.join(section['command'].split()[:2])}`" in page, "the command that made it"
