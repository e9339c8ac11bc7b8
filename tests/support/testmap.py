"""The promises, faults and rules that tests hold, and which tests hold them: python -m tests.support.testmap.

A test says `@pytest.mark.holds("promise 2", "fault lost", "rule 14.3")`. Promises are those of README, rules
those of docs/servers.md section 14.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

TESTS = Path(__file__).parents[1]

PROJECT = TESTS.parent


def numbered(page: str, heading: str) -> dict[str, str]:
    """Return the numbered lines below a heading of one of our documents, each up to its first full stop."""
    section = (PROJECT / page).read_text().partition(f"\n## {heading}")[2].partition("\n## ")[0]
    return dict(re.findall(r"^(\d+)\. (.+?)(?:\. .*)?$", section, re.MULTILINE))


PROMISES = {f"promise {number}": text for number, text in numbered("README.md", "What it promises").items()}

FAULTS = {
    "fault lost": "request or reply lost",
    "fault duplicate": "duplicate, late or reordered reply",
    "fault burst tail": "last burst chunk, burst_complete or EOF NAK lost",
    "fault replay": "replay-slot collision, restarted client, seq wrap",
    "fault refused retry": "retried side effect answered by a refusal",
    "fault burst end": "burst_complete spurious or never; no EOF NAK, or a wrong offset in it",
    "fault long frames": "frames beyond a length are lost",
    "fault chunk size": "chunk size differs from asked; short chunk in mid-file",
    "fault corrupt": "corrupt, cut, oversize, wrong target, foreign client",
    "fault NAK": "NAK at each step, every code",
    "fault stale session": "NoSessionsAvailable or Fail from a leaked session",
    "fault idle close": "server closes an idle session under an open handle",
    "fault reboot": "vehicle reboots",
    "fault another vehicle": "another vehicle takes its place",
    "fault boot time asked": "restart of a vehicle that tells its boot time only when asked",
    "fault leaving": "leaving beside an open that is late or under way",
    "fault growing file": "file grows, shrinks or vanishes meanwhile",
    "fault replaced file": "file replaced by one of the same size meanwhile",
    "fault silence": "link silent for 1 s, 30 s, for good",
    "fault overflow": "queue overflow, slow link, burst against heartbeats",
    "fault odd listing": "directory changes while listed; S entries; long and odd names",
    "fault full card": "write fails mid-file; disk full; flush after loss",
    "fault power": "power or link lost at any request of a change",
    "fault killed program": "program killed, vehicle restarted in mid-write",
    "fault two mounts": "two mounts of one vehicle write",
    "fault overlap": "overlapping calls: mapped pages and appends, truncate and close, claims",
    "fault cancel": "cancel (unmount, SIGINT) at each phase",
}

RULES = {f"rule 14.{number}": text for number, text in numbered("docs/servers.md", "14.").items()}

CATALOGUE = {**PROMISES, **FAULTS, **RULES}

NOT_TESTED = {"rule 14.20"}
"""A session that is closed meanwhile is opened again anyway, so nothing is to be seen."""


def held(source: str) -> Iterator[tuple[str, str]]:
    """Yield (test, key) for each key that a test file's marks name; the test is empty for all of the file."""
    for node in ast.parse(source).body:
        marks: list[ast.expr] = []
        name = ""
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            marks, name = node.decorator_list, node.name
        elif isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "pytestmark":
            marks = [node.value]
        for mark in marks:
            if isinstance(mark, ast.Call) and ast.unparse(mark.func) == "pytest.mark.holds":
                for key in mark.args:
                    yield name, str(ast.literal_eval(key))


def keys_held() -> dict[str, list[str]]:
    """Return the keys that tests name, and which tests hold each."""
    found: dict[str, list[str]] = {}
    for file in sorted(TESTS.rglob("test_*.py")):
        for name, key in held(file.read_text()):
            found.setdefault(key, []).append(re.sub("::$", "", f"{file.relative_to(TESTS)}::{name}"))
    return found


def main() -> None:
    """Print the map."""
    by_key = keys_held()
    for key, text in CATALOGUE.items():
        print(f"{key}: {text}")
        for test in by_key.get(key, ["(no test)"]):
            print(f"    {test}")


if __name__ == "__main__":
    main()
