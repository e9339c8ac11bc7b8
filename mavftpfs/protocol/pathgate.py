"""Keeps writes and requests with a path apart on servers that mix them up. Layer: protocol; pure.

PX4 on NuttX checks each WriteFile against a scratch buffer in which most requests with a path leave that path
(docs/servers.md 8). Once a write was refused for that, or with NAK 8, which may hide it, the two kinds
alternate while a file is written:

| phase | goes out | ends |
|---|---|---|
| writes (first) | WriteFile | when a path waits, and the phase lasted `LEAST` or nothing is to be written |
| paths | requests with a path | when bytes wait, and the phase lasted `LEAST` or no path waits |

No request of one kind goes out while one of the other is in flight, and no phase ends before it could send.
Before the first write after paths the transfer sets the buffer right (`Operation.on_paths`). Each answer lets
the gate look again, so a phase needs no timer.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from math import inf

from mavftpfs.protocol.payload import Opcode
from mavftpfs.protocol.requests import Operation, Request

LEAST, LEAST_TRIPS = 0.5, 4.0
"""Seconds, and round trips, for which a phase lasts at least while both kinds wait."""

LEAVES_PATH = frozenset(
    {
        Opcode.LIST_DIRECTORY,
        Opcode.LIST_DIRECTORY_WITH_TIME,
        Opcode.OPEN_FILE_RO,
        Opcode.OPEN_FILE_WO,
        Opcode.CREATE_FILE,
        Opcode.REMOVE_FILE,
        Opcode.CREATE_DIRECTORY,
        Opcode.REMOVE_DIRECTORY,
        Opcode.TRUNCATE_FILE,
        Opcode.RENAME,
    }
)
"""Requests that leave a path in the buffer. A checksum uses another one."""


class PathGate:
    """Tells which operations may send now. Ask `look` first, each time that something may go out."""

    def __init__(self) -> None:
        self._transfer: Operation | None = None
        self._writes = True
        self._began = -inf
        self._clear = True

    def look(
        self, ops: Sequence[Operation], in_flight: Collection[Request], now: float, rtt: float | None
    ) -> None:
        """Choose the phase. ops: all operations if paths block writes, otherwise none. in_flight: the
        requests in flight."""
        transfer = next((op for op in ops if op.bulk == Opcode.WRITE_FILE), None)
        if transfer is not self._transfer:
            self._transfer, self._writes, self._began = transfer, True, now
        if transfer is None:
            return
        writing, asking = not transfer.idle, any(op.opcode in LEAVES_PATH for op in ops)
        wanted, other = (writing, asking) if self._writes else (asking, writing)
        paths = any(r.opcode in LEAVES_PATH and r.op is not transfer for r in in_flight)
        if paths or not self._writes:
            transfer.on_paths()
        ends = self._began + max(LEAST, LEAST_TRIPS * (rtt or 0.0))
        if other and (not wanted or (self._clear and now >= ends)):
            self._writes, self._began = not self._writes, now
        self._clear = not (paths if self._writes else any(r.op is transfer for r in in_flight))

    def keeps(self, op: Operation) -> bool:
        """Return whether an operation has to wait."""
        if self._transfer is None:
            return False
        if op is self._transfer:
            return not (self._writes and self._clear)
        return op.opcode in LEAVES_PATH and (self._writes or not self._clear)
