"""The bench's own arithmetic: limits, medians, ratios, its JSON file, its pictures and tables."""

from __future__ import annotations

import json
import re
from collections import Counter
from itertools import product
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from mavftpfs.link.framing import Framer
from mavftpfs.link.messages import Address
from mavftpfs.protocol.payload import Opcode, request
from tests.bench import __main__ as entry
from tests.bench import bare, goodput, mount, plots, requests, tables
from tests.bench.cases import Case
from tests.bench.figures import BARE, LINKS, US, Outcome, Row, Run, as_json, limit, row_from_json, summarise
from tests.bench.record import Record
from tests.bench.shaper import frames_of
from tests.support.request_cases import CASES
from tests.support.request_costs import MOUNT, PROFILES, expected
from tests.support.requests import Cost

PROJECT = Path(__file__).parents[2]
TIMEOUTS = {"wifi-5%": 20.0, "unshaped": 10.0}


def run(client: str, seconds: float | None, outcome: Outcome = Outcome.OK, **changes: Any) -> Run:
    """A transfer of 1 MB from PX4 over the lossy link."""
    fields = {"server": "px4", "link": "wifi-5%", "direction": "read", "size": 1_000_000, "cpu": 0.5}
    return Run(**{**fields, "client": client, "seconds": seconds, "outcome": outcome, **changes})


def row_of(rows: list[Row], client: str) -> Row:
    """Return a client's row."""
    return next(row for row in rows if row.client == client)


def test_limit_is_what_design_says() -> None:
    assert limit("px4", "unshaped", "read") is None
    assert limit("px4", "wifi-5%", "read") == pytest.approx(625_000 * 239 / 266 * 0.95)
    shape = LINKS["wifi"]
    assert shape is not None
    assert limit("ardupilot", "wifi", "write") == Case("ardupilot", 625_000, 0.030, 0.0, "write").limit


def test_cases_are_measured_at_once_and_listed_in_order() -> None:
    chosen = [Case("px4", 1e5, 0.01, loss, "write") for loss in (0.0, 0.1)]
    assert goodput.everything(chosen, 1.0) == [goodput.measure(case, 1.0) for case in chosen]


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


def test_pauses_come_one_at_a_time_and_only_so_much_may_wait_for_them() -> None:
    link, pauses = 250_000 * 239 / 266, ([0.0] * 499 + [0.175]) * 20
    read = Case("px4-nuttx", 250_000.0, 0.1, 0.0)
    assert read.limit_beside(pauses) == pytest.approx(link, rel=0.02), "0.35 s wait"
    long = ([0.0] * 999 + [0.35]) * 10
    assert Case("px4-nuttx", 250_000.0, 0.01, 0.0).limit_beside(long) == pytest.approx(0.92 * link, rel=0.01)
    assert read.limit_beside([0.3] * 10) == pytest.approx(239 / 0.3005, rel=0.01), "it does nothing else"


def test_a_row_has_the_median_and_its_shares() -> None:
    runs = [run(US, 2.0), run(BARE, 1.0), run(US, 4.0), run(BARE, 1.6), run(US, 2.5)]
    ours = row_of(summarise(runs, TIMEOUTS), US)
    assert ours.rate == pytest.approx(400_000)
    assert ours.of_us == 1
    assert ours.of_bare == pytest.approx(400_000 / ((1_000_000 + 625_000) / 2))
    assert ours.of_limit == pytest.approx(400_000 / (625_000 * 239 / 266 * 0.95))
    assert (ours.good, ours.runs, ours.at_most) == (3, 3, False)
    assert ours.cpu == pytest.approx(0.5)
    assert ours.per_chunk == pytest.approx(0.5 * 239 / 1e6)


def test_sizes_may_differ_between_clients() -> None:
    rows = summarise([run(US, 2.0, size=4_000_000), run("peer", 1.0, size=500_000)], TIMEOUTS)
    assert row_of(rows, "peer").of_us == pytest.approx(0.25)


def test_who_is_cut_off_has_an_upper_bound() -> None:
    rows = summarise([run(US, 2.0), run("slow", None, Outcome.TIMEOUT, cpu=None)], TIMEOUTS)
    slow = row_of(rows, "slow")
    assert (slow.outcome, slow.rate, slow.at_most, slow.good) == (Outcome.TIMEOUT, 50_000, True, 0)
    assert slow.of_us == pytest.approx(0.1)
    assert mount.cells_of(slow)[:2] == ["< 50.0 (timeout)", "< 0.10"]


@pytest.mark.parametrize("outcome", [Outcome.FAILED, Outcome.CORRUPT, Outcome.UNAVAILABLE])
def test_who_fails_has_no_rate(outcome: Outcome) -> None:
    rows = summarise([run(US, 2.0), run("bad", 1.0, outcome, detail="why")], TIMEOUTS)
    bad = row_of(rows, "bad")
    assert (bad.outcome, bad.rate, bad.of_us, bad.detail) == (outcome, None, None, "why")
    assert mount.cells_of(bad)[0] == outcome


def test_one_good_run_counts_and_the_others_are_counted() -> None:
    rows = summarise([run("peer", None, Outcome.TIMEOUT), run("peer", 2.0)], TIMEOUTS)
    peer = row_of(rows, "peer")
    assert (peer.outcome, peer.rate, peer.good, peer.runs) == (Outcome.OK, 500_000, 1, 2)


def test_nothing_is_compared_with_what_is_missing() -> None:
    alone = row_of(summarise([run("peer", 2.0), run(US, None, Outcome.TIMEOUT)], TIMEOUTS), "peer")
    assert (alone.of_us, alone.of_bare) == (None, None)


def test_a_row_survives_the_file() -> None:
    (row,) = summarise([run(US, 2.0)], TIMEOUTS)
    again = row_from_json(json.loads(json.dumps(as_json(row))))
    assert again.outcome is Outcome.OK
    assert again.rate == pytest.approx(row.rate, rel=1e-3)
    with pytest.raises(TypeError):
        row_from_json({"outcome": "ok", "surprise": 1})


def test_a_section_replaces_only_itself(tmp_path: Path) -> None:
    record = Record(tmp_path / "new" / "results.json")
    assert record.sections() == {}
    record.put("goodput", "scripts/bench goodput", [1], "2026-01-02", 0.1)
    record.put("mount", "scripts/bench mount", {"rows": []}, "", 0.25)
    record.put("goodput", "scripts/bench goodput --quick", [2], "2026-01-03", 0.1)
    found = record.sections()
    assert found["mount"]["results"] == {"rows": []}
    assert found["goodput"]["results"] == [2]
    assert found["goodput"]["date"] == "2026-01-03"
    assert found["mount"]["load"] == 0.2
    assert found["goodput"]["versions"].keys() >= {"python", "mavftpfs", "pymavlink"}


def test_another_kind_of_file_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "mine.json"
    path.write_text('{"precious": 1}')
    with pytest.raises(ValueError, match="not written by this bench"):
        Record(path).put("mount", "", {}, "", 0.0)
    assert path.read_text() == '{"precious": 1}'


def test_the_part_comes_first_and_is_everything_by_default() -> None:
    assert entry.split(["mount", "--quick"]) == ("mount", ["--quick"])
    assert entry.split(["--quick"]) == ("all", ["--quick"])
    with pytest.raises(SystemExit):
        entry.main(["--profiles", "px4"])


def test_each_part_is_run_and_noted(tmp_path: Path) -> None:
    path = tmp_path / "results.json"
    few = ["--profiles", "px4", "--rtts", "0.1", "--losses", "0", "--direction", "read", "--seconds", "2"]
    assert entry.main(["goodput", "--quick", "--json", str(path), "--date", "2026-01-02", *few]) == 0
    section = Record(path).sections()["goodput"]
    (result,) = section["results"]
    assert result["case"]["rate"] == 100_000
    assert 0.3 < result["share"] < 1.1
    assert section["command"] == "scripts/bench goodput --quick " + " ".join(few)
    assert "tmp" not in path.read_text()


def test_the_parts_of_a_chunk_and_the_codec_are_measured(tmp_path: Path) -> None:
    path = tmp_path / "results.json"
    assert entry.main(["cost", "--servers", "--json", str(path)]) == 0
    results = Record(path).sections()["cost"]["results"]
    assert results["parts"].keys() == {"read", "write"}
    assert {part for parts in results["parts"].values() for part in parts} > {"find and check frames"}
    assert len(results["codec"]) == 4, "frames of ours and of pymavlink, which were the same bytes"
    assert (results["copies"], results["memory"]) == ([], [])


def test_quick_is_within_the_default() -> None:
    def cells(*argv: str) -> list[mount.Cell]:
        return mount.chosen_cells(mount.parser().parse_args(argv))

    quick, default = cells("--quick"), cells()
    assert {(cell.server, cell.link) for cell in quick} < {(cell.server, cell.link) for cell in default}
    assert max(cell.timeout for cell in quick) < max(cell.timeout for cell in default)
    assert [cell.server for cell in cells("--servers", "mavsdk", "--links", "wifi")] == ["mavsdk"] * 2
    (own,) = cells(
        "--servers", "px4", "--links", "wifi", "--directions", "read", "--size", "5", "--timeout", "9"
    )
    assert (own.size_for(US), own.size_for("peer"), own.timeout) == (5, 5, 9)
    assert {cell.window for cell in default if cell.server == "ardupilot"} == {4, 5}


def test_datagrams_are_taken_apart_into_frames() -> None:
    framer = Framer(Address(1, 1), stream=False)
    signed = Framer(Address(1, 1), stream=False, signing_key=bytes(32), signing_clock=lambda: 1)
    frames = [framer.encode_heartbeat(2, 12), signed.encode_heartbeat(2, 12)]
    frames += [framer.encode_ftp(Address(255, 190), request(7, Opcode.READ_FILE, data=b"\x05").encode())]
    old = bytes.fromhex("fe09000101000000000002030403") + bytes(3)
    assert list(frames_of(b"".join([*frames, old]))) == [*frames, old]
    assert list(frames_of(b"no MAVLink")) == [b"no MAVLink"]
    assert list(frames_of(frames[0] + b"\xfd\x09")) == [frames[0], b"\xfd\x09"]
    assert list(frames_of(b"")) == []


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


def test_lines_are_those_of_the_fixed_conditions() -> None:
    results = [found for found in sections()["goodput"]["results"] if found["case"]["direction"] == "read"]
    assert plots.middle(results, "rtt") == 0.1
    assert plots.lossy(results) == 0.01
    lines = plots.share_against(results, "loss", {"rate": 1e5, "rtt": 0.1})
    assert lines["px4"] == [(0.0, 0.9), (0.01, 0.89), (0.05, pytest.approx(0.85))]


def test_pictures_are_drawn_and_the_same_each_time(tmp_path: Path) -> None:
    drawn = []
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        paths = plots.plot_all(sections(), tmp_path / name)
        drawn.append({path.name: path.read_text() for path in paths})
    assert drawn[0] == drawn[1]
    assert drawn[0].keys() == {"goodput-loss.svg", "goodput-rtt.svg", "peers.svg"}
    for text in drawn[0].values():
        assert ElementTree.fromstring(text).tag.endswith("svg")
        assert len(text) < 60_000
    assert {"mavftpfs", "peer", "Wi-Fi, 5 % loss", "failed"} <= set(
        re.findall(r">([^<>]+)</", drawn[0]["peers.svg"])
    )
    assert "ardupilot" in drawn[0]["goodput-rtt.svg"]


def test_a_bar_says_why_it_is_missing() -> None:
    runs = [
        run(US, 2.0, link="unshaped"),
        run("slow", None, Outcome.TIMEOUT),
        run("bad", None, Outcome.CORRUPT),
    ]
    rows = summarise(runs, TIMEOUTS)
    assert [plots.note_of(row) for row in rows] == ["no bare loop to compare with", "< 0.09", "wrong bytes"]
    assert [plots.share_of(row) for row in rows] == [0.0, 0.0, 0.0]


def test_who_was_cut_off_shows_how_fast_it_was_at_most() -> None:
    rows = summarise([run(US, 2.0), run("slow", None, Outcome.TIMEOUT)], TIMEOUTS)
    assert [tables.rate_text(row) for row in rows] == ["**500**", "< 50.0 (< 0.10)"]


def test_plots_need_results(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert plots.main(["--json", str(tmp_path / "none.json")]) == 1
    assert "nothing is recorded" in capsys.readouterr().err


def test_tables_go_between_their_marks() -> None:
    marks = [f"<!-- bench: {name} -->old<!-- bench: end -->\n" for name in ("goodput", "peers", "cost")]
    text = "a\n" + "b\n".join(marks) + "c"
    filled = tables.filled_in(text, sections())
    assert filled == tables.filled_in(filled, sections())
    assert "old" not in filled
    assert filled.startswith("a\n")
    assert filled.endswith("\nc")
    assert "| PX4, Wi-Fi, 5 % loss, read | **500** | 500 (1.00) | failed | 500 (1.00) |" in filled
    assert "| mavftpfs | 0.500 / – | 120 / – | – / – |" in filled
    assert "`scripts/bench mount`, 2026-01-02, 2 CPUs.\n" in filled
    with pytest.raises(ValueError, match="goodput"):
        tables.filled_in("no marks", sections())


def test_a_share_below_the_target_over_any_round_trip_shows() -> None:
    runs = [found for found in sections()["goodput"]["results"] if found["case"]["profile"] == "px4"]
    runs[-1] = {**runs[-1], "share": 0.3}  # writing, 5 %, 300 ms
    head, _, line = tables.goodput_table(runs).splitlines()
    assert head == (
        "| profile | kB/s | read, 0 % | read, 1 % | read, 5 % | write, 0 % | write, 1 % | write, 5 % |"
    )
    assert line == "| px4 | 100 | 0.90 | 0.89 | *0.85* | 0.90 | 0.89 | *0.30* |"
    assert "|  |" in tables.goodput_table([*runs, {**runs[0], "case": {**runs[0]["case"], "rate": 1e6}}])


def test_requests_are_counted_by_server_and_named_for_the_first() -> None:
    runs = [
        {"profile": "px4", "command": "rm", "requests": {"remove": 1, "look": 1, "list": 2}, "payload": 0},
        {"profile": "mavsdk", "command": "rm", "requests": {"remove": 1}, "payload": 0},
        {"profile": "px4", "command": "cat warm", "requests": {}, "payload": 0},
    ]
    head, _, *lines = tables.requests_table(runs).splitlines()
    assert head == "| command | px4 | mavsdk | on px4 |"
    assert "| rm | 4 | 1 | list 2, look 1, remove 1 |" in lines
    assert "| cat warm | 0 |  | 0 |" in lines


def test_parts_of_a_packet_and_the_memory_of_large_files() -> None:
    costs = {
        "parts": {"read": {"receive": 0.25, "placing": 0.5}, "write": {"receive": 1.0}},
        "codec": {
            "build a ReadFile": [0.5, 12.0],
            "parse a chunk": [0.25, 7.0],
            "build a WriteFile": [0.3, 7.0],
            "parse an ACK": [0.4, 8.5],
        },
        "memory": [{"what": "read", "size": 10**9, "peak": 112_300_000, "allowed": 138_000_000}],
    }
    table = tables.parts_table(costs)
    assert table.splitlines()[2:7] == [
        "| receive | 0.25 | 1.00 |",
        "| placing | 0.50 |  |",
        "| all of these | 0.75 | 1.00 |",
        "| frames alone | 0.75 | 0.70 |",
        "| frames alone, pymavlink | 19.00 | 15.50 |",
    ]
    assert table.endswith("\n\n1,000 MB read through the mount: 112 MB of memory at most (138 allowed).")
    assert tables.parts_table({**costs, "memory": []}).endswith("15.50 |")


def test_counts_of_a_busy_machine_are_marked_and_none_that_differ_are_written() -> None:
    calm = Cost(Counter({"open": 1, "look": 0}), seconds=1.5)
    busy = Cost(Counter({"open": 2}), repeats=1)
    assert [requests.text_of(cost) for cost in (calm, busy)] == ["open 1", "open 2 (asked again: 1)"]
    assert not requests.is_exact(Cost(late=True))
    assert requests.as_json({"px4": {"cat cold": calm}}) == [
        {"profile": "px4", "command": "cat cold", "requests": {"open": 1}, "payload": 0}
    ]


def test_the_requests_recorded_are_those_that_tests_hold() -> None:
    found = Record(plots.RESULTS).sections()["requests"]["results"]
    wanted = set(product(PROFILES, [MOUNT, *(case.name for case in CASES)]))
    assert {(run["profile"], run["command"]) for run in found} == wanted
    for run in found:
        cost = Cost(Counter(run["requests"]), payload=run["payload"])
        assert cost.text() in expected(run["profile"], run["command"]), f"{run}: scripts/bench requests"


def test_a_busy_machine_is_called_that() -> None:
    busy = {**sections()["mount"], "load": 1.1, "date": ""}
    assert tables.caption(busy).startswith("`scripts/bench mount`, 2 CPUs, busy with other things (load 1.1)")


def test_the_page_shows_what_was_recorded() -> None:
    page = (PROJECT / "docs/benchmarks.md").read_text()
    recorded = Record(plots.RESULTS).sections()
    assert tables.filled_in(page, recorded) == page, "scripts/bench plots --page docs/benchmarks.md"
    pictures = re.findall(r"\]\(\.\./(tests/bench/\S+\.svg)\)", page)
    assert len(pictures) == 3
    assert [name for name in pictures if not (PROJECT / name).is_file()] == []
    for section in recorded.values():
        assert f"`{' '.join(section['command'].split()[:2])}`" in page, "the command that made it"


def test_the_record_names_no_machine() -> None:
    assert re.findall(r"/(?:tmp|home|root|mnt|usr)\b[^\"]*", plots.RESULTS.read_text()) == []
