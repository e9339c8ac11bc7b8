"""Faults at exact places: the link breaks after the Nth request, or one certain reply is lost."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass

from mavftpfs.link.messages import Address
from mavftpfs.protocol.payload import HEADER_SIZE, NakCode, Opcode, decode_request
from mavftpfs.sim.vehicle import FtpServer
from tests.support.replies import nak

STATION = Address(255, 190)
"""Another client of the vehicle, whose requests do not count."""

_OPCODE, _SIZE, _REQ_OPCODE = 3, 4, 5
_TAKING = (Opcode.REMOVE_FILE, Opcode.REMOVE_DIRECTORY, Opcode.RENAME)


@dataclass
class _Meeting:
    """An event at the nth of the requests of a kind from now on, and at `times` - 1 more after it.

    opcode: None for all kinds."""

    opcode: Opcode | None
    nth: int = 1
    times: int = 1
    action: Callable[[], object] = lambda: None
    nak: bytes | None = None
    drop: bool = False
    twice: bool = False

    def comes(self, opcode: int) -> bool:
        """Count a request; return whether this one is meant."""
        if self.opcode not in (None, opcode):
            return False
        self.nth -= 1
        return -self.times < self.nth <= 0

    @property
    def over(self) -> bool:
        """True if nothing more is to happen."""
        return self.nth <= 1 - self.times


class Faults:
    """Stands before a simulated vehicle's FTP server. Of each change of a name it asserts that neither that
    file nor one below it is open (promise 6). Requests of another client pass as they are.

    Attributes:
        requests: opcodes of ours that reached the server so far. asked: the same with their times.
        refused: opcodes of requests that were NAKed.
        spoil: in so many more WriteFiles the first byte arrives as another one.
        orphans: files may be open that we cannot close, because copies of requests come late.
    """

    def __init__(self, server: FtpServer) -> None:
        self.requests: list[int] = []
        self.asked: list[tuple[float, int]] = []
        self.refused: list[int] = []
        self._cut_after: int | None = None
        self._lose: list[int] = []
        self._meetings: list[_Meeting] = []
        self._naks: list[tuple[Address, bytes]] = []
        self.spoil = 0
        self._server = server
        self._taking: set[bytes] = set()
        self.orphans = False
        self._handle, self._outgoing = server.handle, server.outgoing
        server.handle = self._on_request  # type: ignore[method-assign]
        server.outgoing = self._on_replies  # type: ignore[method-assign]

    def cut_after(self, count: int | None) -> None:
        """Let `count` requests through and nothing after them, either way; None ends that."""
        self._cut_after = None if count is None else len(self.requests) + count

    def lose_reply_to(self, opcode: Opcode) -> None:
        """Lose the next reply to a request of this kind."""
        self._lose.append(int(opcode))

    def ignore(self, opcode: Opcode) -> None:
        """Have requests of this kind neither executed nor answered."""
        self._meetings.append(_Meeting(opcode, times=sys.maxsize, drop=True))

    def at(
        self,
        opcode: Opcode,
        action: Callable[[], object],
        *,
        nth: int = 1,
        times: int = 1,
        drop: bool = False,
    ) -> None:
        """Do something before the nth request of this kind from now on, and `times` - 1 more, are executed.
        drop: they never are."""
        self._meetings.append(_Meeting(opcode, nth, times, action, drop=drop))

    def refuse(
        self, opcode: Opcode, code: int, number: int | None = None, *, nth: int = 1, times: int = 1
    ) -> None:
        """NAK the nth request of this kind from now on, and `times` - 1 more, without executing them.
        number: the errno that goes with FAIL_ERRNO."""
        if number is not None:
            assert code == NakCode.FAIL_ERRNO
        codes = bytes([code]) if number is None else bytes([code, number])
        self._meetings.append(_Meeting(opcode, nth, times, nak=codes))

    def after(self, count: int, action: Callable[[], object]) -> None:
        """Do something when `count` more requests came to the server, before the last of them is executed."""
        self._meetings.append(_Meeting(None, count, action=action))

    def repeat(self, count: int) -> None:
        """Have the request arrive twice that comes after `count` - 1 more ones."""
        self._meetings.append(_Meeting(None, count, twice=True))

    def call_off(self) -> None:
        """Cancel the faults that were to happen at certain requests."""
        self._meetings.clear()

    def times(self, opcode: Opcode) -> list[float]:
        """Return when requests of this kind came."""
        return [now for now, asked in self.asked if asked == opcode]

    def _on_request(self, wire: bytes, source: Address, now: float) -> None:
        if self._is_cut():
            return
        self._require_closed(wire)
        if source == STATION:
            self._handle(wire, source, now)
            return
        self.requests.append(wire[_OPCODE])
        self.asked.append((now, wire[_OPCODE]))
        met = [meeting for meeting in self._meetings if meeting.comes(wire[_OPCODE])]
        self._meetings = [meeting for meeting in self._meetings if not meeting.over]
        for meeting in met:
            meeting.action()
        naks = [meeting.nak for meeting in met if meeting.nak is not None]
        if naks:
            self._naks.append((source, nak(decode_request(wire), *naks[0]).encode()))
        elif not any(meeting.drop for meeting in met):
            self._handle(self._spoiled(wire), source, now)
        if any(meeting.twice for meeting in met):
            self._on_request(wire, source, now)

    def _require_closed(self, wire: bytes) -> None:
        if self.orphans or wire[_OPCODE] not in _TAKING or wire in self._taking:
            return
        self._taking.add(wire)  # the link may double it
        for path in wire[HEADER_SIZE : HEADER_SIZE + wire[_SIZE]].split(b"\0"):
            held = [opened for opened in self._server.open_paths if (opened + b"/").startswith(path + b"/")]
            assert not path or not held, f"{Opcode(wire[_OPCODE]).name} of {path!r} while it is open"

    def _spoiled(self, wire: bytes) -> bytes:
        if wire[_OPCODE] != Opcode.WRITE_FILE or not self.spoil:
            return wire
        self.spoil -= 1
        return wire[:HEADER_SIZE] + bytes([wire[HEADER_SIZE] ^ 1]) + wire[HEADER_SIZE + 1 :]

    def _on_replies(self, now: float) -> list[tuple[Address, bytes]]:
        replies, self._naks = [*self._naks, *self._outgoing(now)], []
        self.refused += [wire[_REQ_OPCODE] for _, wire in replies if wire[3] == Opcode.NAK]
        return [reply for reply in replies if not self._is_lost(reply[1])]

    def _is_lost(self, wire: bytes) -> bool:
        if self._is_cut():
            return True
        if wire[_REQ_OPCODE] in self._lose:
            self._lose.remove(wire[_REQ_OPCODE])
            return True
        return False

    def _is_cut(self) -> bool:
        return self._cut_after is not None and len(self.requests) >= self._cut_after
