"""The window on a serial port: the largest one that the far end's receive buffer survives."""

from __future__ import annotations

import random
from functools import cache

import pytest

from mavftpfs.link.messages import Address
from mavftpfs.protocol.flow import SERIAL_CAP, Flow
from mavftpfs.protocol.payload import MAX_DATA, Opcode, decode_request
from mavftpfs.protocol.survival import Survival
from mavftpfs.protocol.writing import WriteTransfer
from mavftpfs.sim.linkmodel import LinkSettings
from tests.support.replies import ack
from tests.support.sources import MemorySource
from tests.support.virtual import VirtualLink

START = 20.0
SECONDS = 60.0
SEEDS = (1, 2)
LOOK = 0.1
SURVIVED = [1, 2, 4, 8, None]
LOSSES = [0.0, 0.05, 0.1, 0.2]


class Port:
    """A receiver that is busy for about LOOK seconds at a time; its buffer holds so many requests then."""

    def __init__(self, holds: int | None) -> None:
        self.holds = holds
        self.lost = self.arrived = 0
        self._rng = random.Random(4)
        self._waiting: list[tuple[bytes, Address]] = []
        self._look_at: float | None = None
        self._outbox: list[tuple[Address, bytes]] = []

    def handle(self, wire: bytes, source: Address, now: float) -> None:
        self.arrived += 1
        if self._look_at is None:
            self._look_at = now + LOOK * self._rng.uniform(0.5, 1.5)
        if self.holds is None or len(self._waiting) < self.holds:
            self._waiting.append((wire, source))
        else:
            self.lost += 1

    def outgoing(self, now: float) -> list[tuple[Address, bytes]]:
        if self._look_at is not None and now >= self._look_at:
            self._look_at = None
            self._outbox += [(source, answer(wire)) for wire, source in self._waiting]
            self._waiting.clear()
        sent, self._outbox = self._outbox, []
        return sent

    def next_deadline(self) -> float | None:
        return self._look_at


class Fixed(Flow):
    """A window that never changes."""

    def on_silence(self, unheard: int = 0) -> None:
        pass

    def _end_round(self, now: float, order: int, next_order: int) -> None:
        pass


def fixed(window: int) -> Flow:
    flow = Fixed()
    flow.window = window
    return flow


def answer(wire: bytes) -> bytes:
    request = decode_request(wire)
    assert request.opcode == Opcode.WRITE_FILE
    return ack(request).encode()


def write(flow: Flow, port: Port, loss: float, *, seed: int = 1) -> float:
    """Write for so long; return bytes per second ACKed after the start, when it has found out."""
    link = VirtualLink(port, LinkSettings(delay=0.01, loss=loss), seed=seed, flow=flow)
    transfer = WriteTransfer(0, MemorySource(bytes(MAX_DATA * 20_000)))
    link.engine.start(transfer, link.now)
    began = link.now
    link.run_until(lambda: link.now >= began + START)
    before, port.arrived, port.lost = transfer.acked_bytes, 0, 0
    link.run_until(lambda: link.now >= began + START + SECONDS)
    return (transfer.acked_bytes - before) / SECONDS


@cache
def best(holds: int | None, loss: float) -> float:
    """Return what a window brings that is right from the beginning and never changes."""
    return write(fixed(SERIAL_CAP if holds is None else holds), Port(holds), loss)


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("holds", SURVIVED)
def test_it_settles_at_what_is_survived(holds: int | None, loss: float) -> None:
    rate, overflow = 0.0, 0.0
    for seed in SEEDS:
        port = Port(holds)
        rate += write(Flow(serial=True), port, loss, seed=seed) / len(SEEDS)
        overflow += port.lost / port.arrived / len(SEEDS)
    assert rate >= 0.85 * best(holds, loss)
    assert overflow <= 0.35  # a wider window is tried now and then


def test_a_long_way_is_full_after_few_rounds_and_the_first_loss_takes_back_one() -> None:
    """One more each round took fifteen of them: 4.5 s over 300 ms."""
    survival = Survival(SERIAL_CAP)
    windows = [survival.end_round(survival.window, 0, 0.3, 0.0) for _ in range(7)]
    assert windows == [2, 3, 4, 6, 9, 13, 16]
    survival = Survival(SERIAL_CAP)
    for _ in range(5):
        survival.end_round(survival.window, 0, 0.3, 0.0)
    assert survival.end_round(8, 1, 0.3, 0.0) == 6


def test_it_grows_where_little_is_asked_for_by_what_was_in_flight_at_once() -> None:
    """Listings and an open had been answered, and the first read, and the window was still one."""
    survival = Survival(SERIAL_CAP)
    assert [survival.end_idle_round(sent, 0) for sent in (1, 1, 2, 2, 2)] == [2, 2, 3, 3, 3]
    assert survival.end_idle_round(3, 1) == 3  # a lost one says nothing of a buffer there
    assert survival.end_round(3, 0, 0.3, 0.0) == 4
    assert survival.end_round(4, 1, 0.3, 0.0) == 2
    assert survival.end_idle_round(16, 0) == 2  # from here on it compares


def test_where_a_queue_stands_it_holds_what_fills_the_way() -> None:
    """Nine had half a second of answers before them where three fill the way."""
    survival = Survival(SERIAL_CAP)
    for rate in (9.0, 18.0, 27.0, 36.0, 38.0):
        survival.end_round(survival.window, 0, survival.window / rate, 0.0)
    assert survival.window == 9
    assert survival.end_round(9, 0, 9 / 38.0, 0.0, most=5.4) == 5
    held = [survival.end_round(5, 0, 5 / 38.0, 1.0) for _ in range(20)]
    assert held == [5] * 20
    later = [survival.end_round(5, 0, survival.window / 38.0, 9.0) for _ in range(60)]
    assert set(later) == {5, 6}  # it looks again now and then
