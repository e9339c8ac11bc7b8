"""Runs of the bench beside the peers, and the figures made of them. Pure."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from enum import StrEnum
from statistics import median
from typing import Any

from tests.bench.cases import Case, Direction

US = "mavftpfs"
BARE = "bare loop"


class Outcome(StrEnum):
    """The end of a run; the bytes of each run that ended by itself are compared."""

    OK = "ok"
    TIMEOUT = "timeout"
    FAILED = "failed"
    CORRUPT = "corrupt"


@dataclass(frozen=True, slots=True)
class LinkShape:
    """rate: bytes/s each way. rtt: seconds without queueing. loss: share of frames, each way."""

    rate: float
    rtt: float
    loss: float

    @property
    def queue(self) -> int:
        """Bytes that wait for the transmitter: half a second, as in the virtual bench."""
        return int(max(4096, self.rate / 2))


LINKS: dict[str, LinkShape | None] = {
    "unshaped": None,
    "wifi": LinkShape(625_000, 0.030, 0.0),
    "wifi-1%": LinkShape(625_000, 0.030, 0.01),
    "wifi-5%": LinkShape(625_000, 0.030, 0.05),
    "57600": LinkShape(5760, 0.100, 0.0),
}
"""The links of the bench; `unshaped` is the loopback itself."""


REAL_MAVSDK = "mavsdk-real"
"""The MAVSDK library's own server; every other name is a profile of the simulator."""

WINDOWS = {"ardupilot": 5, REAL_MAVSDK: 32}
LOOPBACK_WINDOW = 64


@dataclass(frozen=True, slots=True)
class Cell:
    """The same work for every client. size, peers_size: bytes. timeout: seconds."""

    server: str
    link: str
    direction: Direction
    size: int
    peers_size: int
    timeout: float

    @property
    def shape(self) -> LinkShape | None:
        """The link, None for the bare loopback."""
        return LINKS[self.link]

    @property
    def window(self) -> int:
        """Requests in flight that fill the link and that the server can hold: for clients that must be
        told."""
        server = WINDOWS.get(self.server, 10_000)
        if self.shape is None:
            return min(server, LOOPBACK_WINDOW)
        return min(server, max(4, int(1.5 * self.shape.rate * self.shape.rtt / 266)))

    @property
    def patience(self) -> float:
        """Seconds after which a request is lost, for clients that must be told: twice a full window's
        trip."""
        if self.shape is None:
            return 0.25
        return 0.1 + 2 * (self.shape.rtt + self.window * 277 / self.shape.rate)


@dataclass(frozen=True, slots=True)
class Measured:
    """The result of a transfer. seconds: from the first call to the last. cpu: seconds, user and system, of
    the client's processes while it lasted. memory: their peak in bytes. None if it did not end well.
    """

    outcome: Outcome
    seconds: float | None = None
    cpu: float | None = None
    memory: int | None = None
    detail: str = ""


@dataclass(frozen=True, slots=True)
class Run:
    """One transfer. size: bytes."""

    server: str
    link: str
    direction: Direction
    client: str
    size: int
    measured: Measured

    @property
    def outcome(self) -> Outcome:
        """The end of the run."""
        return self.measured.outcome


@dataclass(frozen=True, slots=True)
class Row:
    """The summary of one client's runs under the same conditions: medians of those that went well.

    rate: bytes/s; at_most: it was cut off by the time-out, and rate and shares are what it can have reached.
    of_us, of_bare, of_limit: shares. cpu: seconds per 10**6 bytes. memory: peak in bytes.
    """

    server: str
    link: str
    direction: Direction
    client: str
    outcome: Outcome
    rate: float | None
    at_most: bool
    of_us: float | None
    of_bare: float | None
    of_limit: float | None
    cpu: float | None
    memory: int | None


def limit(server: str, link: str, direction: Direction) -> float | None:
    """Return the bytes per second that a shaped link allows, None for the unshaped one."""
    shape = LINKS[link]
    if shape is None:
        return None
    return Case(server, shape.rate, shape.rtt, shape.loss, direction).limit


def summarise(runs: Iterable[Run], timeouts: dict[str, float]) -> list[Row]:
    """Return one row for each client in each cell, in the order of their first runs.

    timeouts: seconds after which runs on a link were cut off.
    """
    groups: dict[tuple[str, str, Direction, str], list[Run]] = {}
    for run in runs:
        groups.setdefault((run.server, run.link, run.direction, run.client), []).append(run)
    rates = {key: _rate(group, timeouts[key[1]]) for key, group in groups.items()}
    rows = []
    for key, group in groups.items():
        server, link, direction, _ = key
        rate, at_most = rates[key]
        ours, bare = (rates.get((server, link, direction, name), (None, False)) for name in (US, BARE))
        good = [run for run in group if run.outcome is Outcome.OK]
        cpu = _median(run.measured.cpu / run.size for run in good if run.measured.cpu is not None)
        row = Row(
            *key,
            outcome=good[0].outcome if good else group[-1].outcome,
            rate=rate,
            at_most=at_most,
            of_us=ratio(rate, None if ours[1] else ours[0]),
            of_bare=ratio(rate, None if bare[1] else bare[0]),
            of_limit=ratio(rate, limit(server, link, direction)),
            cpu=None if cpu is None else cpu * 1e6,
            memory=max(
                (run.measured.memory for run in group if run.measured.memory is not None), default=None
            ),
        )
        rows.append(row)
    return rows


def _rate(group: list[Run], timeout: float) -> tuple[float | None, bool]:
    """Return bytes per second, and whether that is only an upper bound."""
    rate = _median(
        run.size / run.measured.seconds
        for run in group
        if run.outcome is Outcome.OK and run.measured.seconds is not None
    )
    if rate is not None:
        return rate, False
    cut_off = [run.size / timeout for run in group if run.outcome is Outcome.TIMEOUT]
    return (min(cut_off), True) if cut_off else (None, False)


def _median(values: Iterable[float]) -> float | None:
    found = list(values)
    return median(found) if found else None


def ratio(value: float | None, reference: float | None) -> float | None:
    """Return value / reference, None where one of them is missing."""
    return None if value is None or not reference else value / reference


def as_json(row: Row) -> dict[str, Any]:
    """Return a row as JSON has it: few digits, so that a rerun differs where it matters."""
    return {
        key: float(f"{value:.4g}") if isinstance(value, float) else value
        for key, value in asdict(row).items()
    }


def row_from_json(fields: dict[str, Any]) -> Row:
    """Return a row that `as_json` wrote.

    Raises:
        TypeError, ValueError: it is not one.
    """
    return Row(**{**fields, "outcome": Outcome(fields["outcome"])})
