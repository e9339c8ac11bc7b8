"""Lines that a log must not hold. A traceback or an unexpected warning of any process fails its test."""

from __future__ import annotations

import re
from collections.abc import Iterable

SUSPECT = re.compile(
    r"Traceback|\bException\b|was never awaited|ResourceWarning|RuntimeWarning|DeprecationWarning"
    r"|Fatal Python error|AssertionError|core dumped|\bCRITICAL\b|\bERROR\b|\bWARNING\b"
)


def suspects(text: str, allowed: Iterable[str] = ()) -> list[str]:
    """Return the suspicious lines of `text` that match none of the `allowed` patterns."""
    patterns = [re.compile(pattern) for pattern in allowed]
    return [
        line
        for line in text.splitlines()
        if SUSPECT.search(line) and not any(pattern.search(line) for pattern in patterns)
    ]


def assert_clean(name: str, text: str, allowed: Iterable[str] = ()) -> None:
    """Fail with the whole text if a line of it is suspicious."""
    found = suspects(text, allowed)
    assert not found, f"{name} logged {found}\n--- all of it ---\n{text[-20000:]}"
