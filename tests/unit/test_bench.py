"""The bench's own arithmetic: limits, medians, ratios, its JSON file, its pictures and tables."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from mavftpfs.link.framing import Framer
from mavftpfs.link.messages import Address
from mavftpfs.protocol.payload import Opcode, request
from tests.bench import __main__ as entry
from tests.bench import bare, plots, record, tables
from tests.bench.cases import Case
from tests.bench.figures import BARE, US, Outcome, Run, as_json, summarise

PROJECT = Path(__file__).parents[2]
TIMEOUTS = {"wifi-5%": 20.0, "unshaped": 10.0}


def run(client: str, seconds: float | None, outcome: Outcome = Outcome.OK, **changes: Any) -> Run:
    """A transfer of 1 MB from PX4 over the lossy link."""
    fields = {"server": "px4", "link": "wifi-5%", "direction": "read", "size": 1_000_000, "cpu": 0.5}
    return Run(**{**fields, "client": client, "seconds": seconds, "outcome": outcome, **changes})


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


def test_a_part_is_run_and_noted_beside_the_others(tmp_path: Path) -> None:
    path = tmp_path / "results.json"
    record.put(path, "mount", ["--json", str(path), "--quick"], 0.5, {"rows": []})
    few = ["--profiles", "px4", "--rates", "100000", "--rtts", "0.1", "--losses", "0"]
    few += ["--direction", "read", "--seconds", "2"]
    assert entry.main(["goodput", *few, "--json", str(path)]) == 0
    sections = record.sections(path)
    assert sections["mount"]["command"] == "scripts/bench mount --quick"
    (result,) = sections["goodput"]["results"]
    assert result["case"]["rate"] == 100_000
    assert 0.3 < result["share"] < 1.1
    assert sections["goodput"]["command"] == "scripts/bench goodput " + " ".join(few)
    assert "tmp" not in path.read_text()


@pytest.mark.parametrize("data", [b"", b"\x00", b"/log\x00", bytes(range(239))])
def test_the_bare_loop_sends_what_the_reference_sends(data: bytes) -> None:
    made = request(7, Opcode.WRITE_FILE, offset=478, data=data).encode()
    reference = Framer(Address(bare.SYSTEM, bare.COMPONENT), stream=False)
    expected = reference.encode_ftp(Address(1, 1), made)
    assert bare.frame(bare.FTP_ID, bare.FTP_EXTRA, bytes((0, 1, 1)) + made, expected[4]) == expected


# -- pictures and tables ----------------------------------------------------------------------------


def sections() -> dict[str, dict[str, Any]]:
    """Results as the file has them, made up."""
    goodput_runs = [
        {
            "case": {"profile": profile, "rate": 1e5, "rtt": rtt, "loss": loss, "direction": direction},
            "share": 0.9 - loss,
            "target": 0.86,
        }
        for profile in ("px4", "ardupilot")
        for rtt in (0.01, 0.1, 0.3)
        for loss in (0.0, 0.01, 0.05)
        for direction in ("read", "write")
    ]
    runs = [run(client, 2.0, direction=way) for client in (BARE, US, "peer") for way in ("read", "write")]
    runs += [run(client, 2.0, link="unshaped") for client in (US, BARE)]
    runs += [run("gone", None, outcome) for outcome in (Outcome.TIMEOUT, Outcome.FAILED)]
    rows = [as_json(row) for row in summarise(runs, TIMEOUTS)]
    mount = {"command": "scripts/bench mount", "cpus": 2, "date": "2026-01-02", "load": 0.9}
    goodput = {"command": "scripts/bench goodput --rates 100000", "date": "2026-01-02"}
    return {"goodput": {**goodput, "results": goodput_runs}, "mount": {**mount, "results": {"rows": rows}}}


def test_tables_go_between_their_marks() -> None:
    marks = [
        f"<!-- bench: {name} -->stale<!-- bench: end -->\n"
        for name in ("requests", "goodput", "peers", "cost")
    ]
    text = "a\n" + "b\n".join(marks) + "c"
    filled = tables.filled_in(text, sections())
    assert filled == tables.filled_in(filled, sections())
    assert "stale" not in filled
    assert filled.startswith("a\n")
    assert filled.endswith("\nc")
    assert "| PX4, Wi-Fi, 5 % loss, read | **500** | 500 (1.00) | failed | 500 (1.00) |" in filled
    assert "| mavftpfs | 0.500 / – | 120 / – | – / – |" in filled
    assert "`scripts/bench mount`, 2026-01-02, 2 CPUs.\n" in filled
    with pytest.raises(ValueError, match="requests"):
        tables.filled_in("no marks", sections())


def test_the_page_shows_what_was_recorded() -> None:
    page = (PROJECT / "docs/benchmarks.md").read_text()
    recorded = record.sections(plots.RESULTS)
    assert tables.filled_in(page, recorded) == page, "scripts/bench plots --page docs/benchmarks.md"
    pictures = re.findall(r"\]\(\.\./(tests/bench/\S+\.svg)\)", page)
    assert len(pictures) == 2
    assert [name for name in pictures if not (PROJECT / name).is_file()] == []
    for section in recorded.values():
        assert f"`{' '.join(section['command'].split()[:2])}`" in page, "the command that made it"
