"""What the bench takes for the limit of a link, and the page that shows what it recorded."""

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
    assert (PROJECT / picture).is_file()
    for section in recorded.values():
        assert f"`{' '.join(section['command'].split()[:2])}`" in page, "the command that made it"
