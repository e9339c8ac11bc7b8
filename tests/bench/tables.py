"""The bench's figures as docs/benchmarks.md shows them: Markdown, between marks that are kept. Pure."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import Any

from mavftpfs.protocol.payload import MAX_DATA
from tests.bench.figures import BARE, US, Outcome, Row, row_from_json
from tests.support.request_costs import PROFILES, expected

BUSY = 0.5
"""Load for each CPU, before a measurement, above which rates are too low."""

NOISE = 0.02
"""How much the share of one seed differs from that of another, about."""

BEGIN, END = "<!-- bench: {} -->", "<!-- bench: end -->"

_SERVERS = {"px4": "PX4", "ardupilot": "ArduPilot", "mavsdk": "MAVSDK", "mavsdk-real": "MAVSDK"}
_LINKS = {
    "unshaped": "loopback",
    "wifi": "Wi-Fi",
    "wifi-1%": "Wi-Fi, 1 % loss",
    "wifi-5%": "Wi-Fi, 5 % loss",
    "57600": "57,600 baud",
}
_COMMANDS = (
    "ls -l cold",
    "ls -l cached",
    "cat cold",
    "cat warm",
    "stat known names",
    "stat unknown names",
    "find cold",
    "cp 10 files from it",
    "touch old",
    "echo > new",
    "echo >>",
    "mv",
    "rm",
    "vim save",
    "cp 10 files to it",
    "rsync unchanged",
    "git status again",
)
"""Whose requests are shown."""


def server_name(server: str) -> str:
    """Return how a server is called in print."""
    return _SERVERS.get(server, server)


def link_name(link: str) -> str:
    """Return how a link is called in print."""
    return _LINKS.get(link, link)


def markdown(head: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """Return a table."""
    rows = [head, ["---"] * len(head), *lines]
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def clients_of(rows: Iterable[Row]) -> list[str]:
    """Return the clients, ours first."""
    return sorted(dict.fromkeys(row.client for row in rows), key=lambda name: (name != US, name == BARE))


def peers_table(rows: Sequence[Row]) -> str:
    """Return rates in kB/s, and of the other clients which share of that of mavftpfs they reach."""
    names = clients_of(rows)
    found = {(row.server, row.link, row.direction, row.client): row for row in rows}
    lines = []
    for cell in dict.fromkeys((row.server, row.link, row.direction) for row in rows):
        server, link, direction = cell
        texts = [rate_text(found.get((*cell, name))) for name in names]
        lines.append([f"{server_name(server)}, {link_name(link)}, {direction}", *texts])
    return markdown(["kB/s (share of mavftpfs)", *names], lines)


def rate_text(row: Row | None) -> str:
    """Return one cell of that table."""
    if row is None:
        return ""
    if row.rate is None or row.outcome not in (Outcome.OK, Outcome.TIMEOUT):
        return failure(row.outcome)
    bound = "< " if row.at_most else ""
    rate = f"{bound}{_digits(row.rate / 1000)}"
    if row.client == US:
        return f"**{rate}**"
    return rate if row.of_us is None else f"{rate} ({bound}{_digits(row.of_us)})"


def failure(outcome: Outcome) -> str:
    """Return why there is no rate."""
    return "wrong bytes" if outcome is Outcome.CORRUPT else str(outcome)


def _digits(value: float) -> str:
    """Return three digits or so."""
    if value >= 100:
        return f"{value:,.0f}"
    return f"{value:.1f}" if value >= 10 else f"{value:.2f}"


def cost_table(rows: Sequence[Row], server: str, link: str) -> str:
    """Return CPU time and memory of each client under one pair of conditions, reading / writing."""
    chosen = [row for row in rows if (row.server, row.link) == (server, link)]
    lines = []
    for name in clients_of(chosen):
        own = {row.direction: row for row in chosen if row.client == name}
        both = (own.get("read"), own.get("write"))
        cpu = [None if row is None or row.cpu is None else f"{row.cpu:.3f}" for row in both]
        chunk = [None if row is None or row.cpu is None else f"{row.cpu * MAX_DATA:.0f}" for row in both]
        memory = [None if row is None or row.memory is None else f"{row.memory / 1e6:.0f}" for row in both]
        lines.append([name, *(" / ".join(value or "–" for value in pair) for pair in (cpu, chunk, memory))])
    head = ["read / write", "CPU seconds per MB", "µs per packet of 239 bytes", "peak memory, MB"]
    return markdown(head, lines)


def goodput_table(results: Sequence[dict[str, Any]]) -> str:
    """Return the least share of the limit over all round trips, by profile, rate, direction and loss.

    In italics where one of these is below its target.
    """
    cells: dict[tuple[str, float], dict[tuple[str, float], list[dict[str, Any]]]] = {}
    for run in results:
        case = run["case"]
        trouble = case.get("trouble", "none")
        profile = case["profile"] if trouble == "none" else f"{case['profile']}, {trouble}"
        cells.setdefault((profile, case["rate"]), {}).setdefault(
            (case["direction"], case["loss"]), []
        ).append(run)
    columns = sorted({column for found in cells.values() for column in found})
    head = [f"{direction}, {loss * 100:g} %" for direction, loss in columns]
    lines = [
        [profile, f"{rate / 1000:g}", *(_least_share(found.get(column, [])) for column in columns)]
        for (profile, rate), found in cells.items()
    ]
    return markdown(["profile", "kB/s", *head], lines)


def changes_table(before: Sequence[dict[str, Any]], after: Sequence[dict[str, Any]]) -> str:
    """Return the cells whose share changed by more than NOISE, and how the means changed by direction."""
    earlier = {_cell(run): run for run in before}
    both = [(earlier[_cell(run)], run) for run in after if _cell(run) in earlier]
    lines = []
    for old, new in both:
        if abs(new["share"] - old["share"]) > NOISE:
            pairs = [f"{old[name]:.2f} -> {new[name]:.2f}" for name in ("share", "requests")]
            lines.append([*map(str, _cell(new)), *pairs])
    for direction in ("read", "write"):
        pair = [(old, new) for old, new in both if new["case"]["direction"] == direction]
        means = [
            " -> ".join(
                f"{sum(run[name] for run in runs) / len(runs):.3f}" for runs in zip(*pair, strict=True)
            )
            for name in ("share", "requests")
        ]
        lines.append([f"mean of {len(pair)} cells", "", "", "", direction, "", *means])
    return markdown(["profile", "rate", "rtt", "loss", "direction", "trouble", "share", "requests"], lines)


def _cell(run: dict[str, Any]) -> tuple[Any, ...]:
    """Return a run's conditions."""
    case = {"trouble": "none", **run["case"]}
    return tuple(case[name] for name in ("profile", "rate", "rtt", "loss", "direction", "trouble"))


def _least_share(runs: Sequence[dict[str, Any]]) -> str:
    if not runs:
        return ""
    text = f"{min(run['share'] for run in runs):.2f}"
    missed = any(run["target"] is not None and run["share"] < run["target"] for run in runs)
    return f"*{text}*" if missed else text


def requests_table() -> str:
    """Return how many requests a command is on each server, and of which kinds on the first of them."""
    lines = []
    for name in _COMMANDS:
        costs = [expected(profile, name)[0].partition(";")[0] for profile in PROFILES]
        totals = [str(sum(map(int, re.findall(r"\d+", cost)))) for cost in costs]
        lines.append([name, *totals, costs[0]])
    return markdown(["command", *PROFILES, f"on {PROFILES[0]}"], lines)


def caption(section: dict[str, Any]) -> str:
    """Return what made a section, and on what; a machine that was busy with other things is called that."""
    made = f"{section['date']}, {section['cpus']} CPUs".removeprefix(", ")
    if section["load"] > BUSY * section["cpus"]:
        made += f", busy with other things (load {section['load']}), so that rates over loopback are too low"
    return f"`{section['command']}`, {made}."


def tables(sections: dict[str, dict[str, Any]]) -> dict[str, str]:
    """Return the tables by the name of their mark."""
    found = {"requests": f"{requests_table()}\n\n`tests/mount/test_requests.py` holds each number."}
    if "goodput" in sections:
        section = sections["goodput"]
        made = f"`{section['command']}`, {section['date']}; on virtual time, so the same on any machine."
        found["goodput"] = f"{goodput_table(section['results'])}\n\n{made}"
    if "mount" in sections:
        rows = [row_from_json(fields) for fields in sections["mount"]["results"]["rows"]]
        found["peers"] = f"{peers_table(rows)}\n\n{caption(sections['mount'])}"
        found["cost"] = cost_table(rows, "px4", "unshaped")
    return found


def filled_in(text: str, sections: dict[str, dict[str, Any]]) -> str:
    """Return a text with the tables between their marks.

    Raises:
        ValueError: a mark is missing.
    """
    for name, table in tables(sections).items():
        begin = BEGIN.format(name)
        before, found, rest = text.partition(begin)
        _, ended, after = rest.partition(END)
        if not (found and ended):
            raise ValueError(f"no {begin} ... {END}")
        text = f"{before}{begin}\n\n{table}\n\n{END}{after}"
    return text
