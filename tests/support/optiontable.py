"""The guide's table of options, made from that of the code by `python -m tests.support.optiontable`."""

from __future__ import annotations

import re
from pathlib import Path

from mavftpfs.shared.options import TABLE

GUIDE = Path(__file__).parents[2] / "docs/guide.md"
HEAD = "| option | default | meaning |\n|---|---|---|\n"
PLACE = re.compile(re.escape(HEAD) + r"(?:\|.*\n)*")


def option_table() -> str:
    """Return the table in Markdown."""
    rows = []
    for row in TABLE.rows:
        names = ", ".join(f"`{name}`" for name in row.names)
        rows.append(f"| {names} | {row.default} | {row.help} |\n")
    return HEAD + "".join(rows)


def told_table() -> str:
    """Return the table that the guide has, or "" if it has none."""
    found = PLACE.search(GUIDE.read_text())
    return "" if found is None else found.group()


if __name__ == "__main__":
    GUIDE.write_text(PLACE.sub(lambda _: option_table(), GUIDE.read_text()))
