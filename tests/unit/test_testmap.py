"""tests/README.md maps promises, faults and server facts to tests; what it names must exist."""

from __future__ import annotations

import re
from pathlib import Path

TESTS = Path(__file__).parents[1]
PAGE = (TESTS / "README.md").read_text()

TEST_ID = re.compile(r"`((?:unit|property|sim|ops|conformance|mount)/\w+\.py)(?:::(\w+))?`")
ROW = re.compile(r"^\| (\S.*?) \|(.*)\|$", re.MULTILINE)
REASON = "Not a test:"
"""How a row without a test begins to say why."""


def rows() -> dict[str, str]:
    """Return first column -> second column of all table rows but headers."""
    found = {key: text for key, text in ROW.findall(PAGE) if not key.startswith("-")}
    return {key: text for key, text in found.items() if not text.endswith("held by ")}


def missing_ids(text: str) -> list[str]:
    """Return the named tests that do not exist."""
    return [
        f"{file}::{name}"
        for file, name in TEST_ID.findall(text)
        if not (TESTS / file).is_file() or (name and f"def {name}(" not in (TESTS / file).read_text())
    ]


def test_every_named_test_exists() -> None:
    assert missing_ids(PAGE) == []


def test_every_row_names_a_test_or_a_reason() -> None:
    bare = [key for key, text in rows().items() if not TEST_ID.search(text) and REASON not in text]
    assert bare == []


def test_all_promises_faults_and_client_rules_have_a_row() -> None:
    keys = list(rows())
    assert sum(key.startswith("Promise ") for key in keys) == 10
    assert [key for key in keys if key.startswith("14.")] == [f"14.{n}" for n in range(1, 40)]


def test_the_checker_sees_a_test_that_does_not_exist() -> None:
    assert missing_ids("`unit/test_testmap.py::test_nothing` and `mount/test_gone.py`") == [
        "unit/test_testmap.py::test_nothing",
        "mount/test_gone.py::",
    ]
    assert missing_ids("`unit/test_testmap.py::missing_ids`") == []
