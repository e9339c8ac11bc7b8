"""What tests hold: promises, faults and rules, and which tests say so: python -m tests.support.testmap.

A test says `@pytest.mark.holds("promise 2", "fault lost", "rule 14.3")`. Promises are those of README, rules
those of docs/servers.md section 14.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

TESTS = Path(__file__).parents[1]

PROMISES = {
    "promise 1": "right bytes or an error",
    "promise 2": "fsync or close = on the card",
    "promise 3": "nothing accepted is lost",
    "promise 4": "never hangs",
    "promise 5": "comes back by itself",
    "promise 6": "polite and harmless",
    "promise 7": "interactive stays interactive",
    "promise 8": "bounded",
    "promise 9": "safe in flight",
    "promise 10": "no trust in the peer",
}

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

RULES = {
    "rule 14.1": "random first seq, one counter",
    "rule 14.2": "what makes a reply believable",
    "rule 14.3": "jump after a burst",
    "rule 14.4": "which retries keep their seq",
    "rule 14.5": "only data[:size]",
    "rule 14.6": "the id in the open ACK",
    "rule 14.7": "one open file",
    "rule 14.8": "the open session's id in all requests",
    "rule 14.9": "keep-alive, or assume it is gone",
    "rule 14.10": "a stale session is waited out in silence",
    "rule 14.11": "Terminate, and check its reply",
    "rule 14.12": "verify where ids are shared",
    "rule 14.13": "clamp reads; @ files by constant blocks",
    "rule 14.14": "sizes 1..239",
    "rule 14.15": "place by offset; the end is a hint",
    "rule 14.16": "no second burst but after quiet",
    "rule 14.17": "gaps after the burst",
    "rule 14.18": "bursts only for who asks for them, and while nobody else asks anything",
    "rule 14.19": "endless streams",
    "rule 14.20": "keep a long burst's session alive",
    "rule 14.21": "growing files end at the opened size",
    "rule 14.22": "write by a temporary name",
    "rule 14.23": "short writes",
    "rule 14.24": "write window",
    "rule 14.25": "truncate",
    "rule 14.26": "no empty WriteFile",
    "rule 14.27": "2 GiB and 4 GiB",
    "rule 14.28": "pages by non-empty strings",
    "rule 14.29": "ends of a listing, capped",
    "rule 14.30": "list only directories, open only files",
    "rule 14.31": "opcode 16 probed once",
    "rule 14.32": ". beside /",
    "rule 14.33": "paths",
    "rule 14.34": "check targets and types first",
    "rule 14.35": "errno by context",
    "rule 14.36": "silence is an answer",
    "rule 14.37": "heartbeats first, explicit ids, one port",
    "rule 14.38": "timers follow the round trip; slow requests are not piled up",
    "rule 14.39": "other clients",
}

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
            marks = node.value.elts if isinstance(node.value, ast.List) else [node.value]
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
