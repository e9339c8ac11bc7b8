"""The limit that the bench assumes for a link, and the page that shows its records."""

from __future__ import annotations

import re
from pathlib import Path

from tests.bench import record, tables

PROJECT = Path(__file__).parents[2]


def test_the_page_shows_what_was_recorded() -> None:
    page = (PROJECT / "docs/benchmarks.md").read_text()
    recorded = record.sections(record.RESULTS)
    assert tables.filled_in(page, recorded) == page, "scripts/bench plots --page docs/benchmarks.md"
    (picture,) = re.findall(r"\]\(\.\./(tests/bench/\S+\.svg)\)", page)
    shares = re.findall(r">(?:&lt; )?(\d\.\d\d)</text>", (PROJECT / picture).read_text())
    assert shares
    assert max(map(float, shares)) <= 1, "a share above 1 counts as 1"
    for section in recorded.values():
        assert f"`{' '.join(section['command'].split()[:2])}`" in page, "the command that made it"
