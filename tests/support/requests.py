"""The cost of commands on a real mount: FTP requests by opcode, counted by the vehicle that got them.

A `Case` is a shell script that runs in a directory of its own on the mount. It is counted from its first
request to the last one that follows of it (the Terminate of an idle file, a background delivery). Listings
are kept for the whole run (dir_timeout), so that what is cached does not depend on the time.

Keep-alive requests (opcode 0) depend on time and are counted apart. Where the client repeated a request,
because the machine was too busy to answer in time, the repetitions that it reports have to explain every
request too many.

Before a new file gets its name that is opened, to see that it is free, unless a listing less than FREE_FOR
old lacks it, and before names are removed the directory is listed, unless it was so lately. A case that is
`aged` waits until that is over; in the others it may be over where the machine is busy.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mavftpfs.protocol.payload import Opcode, Payload
from mavftpfs.sim.tree import DirectoryTree
from tests.support.lying import LyingVehicle
from tests.support.mounts import Mount
from tests.support.request_costs import Case
from tests.support.twins import PRELUDE
from tests.support.vehicles import HOST, free_udp_port

FREE_FOR = 2.0
SETTLED = 0.3
"""Seconds without a request, with nothing open and nothing to deliver, after which a command has had its
effects."""

LOST = 10.0
"""Seconds after which a request that did not come will not come."""

SETTLING = 60.0
KEEP_ALIVE = "NONE"
FOLDERS = {"px4-nuttx": "fs/microsd"}
ROOM = "cases"
"""The directory of the card in which each case has its own."""

OPTIONS = ("dir_timeout=3600",)

SHORT = {
    "LIST_DIRECTORY": "list",
    "LIST_DIRECTORY_WITH_TIME": "list",
    "OPEN_FILE_RO": "open",
    "OPEN_FILE_WO": "open-wo",
    "CREATE_FILE": "create",
    "READ_FILE": "read",
    "BURST_READ_FILE": "burst",
    "WRITE_FILE": "write",
    "TERMINATE_SESSION": "close",
    "CALC_FILE_CRC32": "crc",
    "RENAME": "rename",
    "REMOVE_FILE": "remove",
    "TRUNCATE_FILE": "truncate",
    "CREATE_DIRECTORY": "mkdir",
    "REMOVE_DIRECTORY": "rmdir",
    "RESET_SESSIONS": "reset",
}
"""Both opcodes for listing are one thing here: a server answers one of them."""


@dataclass(slots=True)
class Cost:
    """The cost of one run of a case. payload: bytes of file data asked for or sent. repeats: how many of the
    requests the client says were repetitions. late: names were listed once more, because time had passed."""

    counts: Counter[str] = field(default_factory=Counter)
    keep_alives: int = 0
    payload: int = 0
    repeats: int = 0
    late: bool = False
    seconds: float = 0.0

    def text(self) -> str:
        """Return it as words: "open 1, read 2, close 1; 300 B", or "0"."""
        words = [f"{name} {self.counts[name]}" for name in dict.fromkeys(SHORT.values()) if self.counts[name]]
        data = f"; {self.payload} B" if self.payload else ""
        return ", ".join(words) + data or "0"


class CountedVehicle(LyingVehicle):
    """A simulated vehicle that keeps each FTP request before it does as it says."""

    def __init__(self, root: Path, profile: str) -> None:
        super().__init__(DirectoryTree(root), f"udpout:{HOST}:{free_udp_port()}", profile=profile)
        self.profile = profile
        self._requests: list[Payload] = []
        self.server.answer = self._requests.append  # which answers nothing

    def __exit__(self, *args: Any) -> None:
        left = self.sessions()
        super().__exit__(*args)
        assert left == 0, "a session was left open"

    def asked(self) -> int:
        """Return how many requests came so far."""
        return len(self._requests)

    def sessions(self) -> int:
        """Return how many sessions its server has open."""
        return self.server.open_sessions

    def cost_since(self, mark: int) -> Cost:
        """Return the requests that came after the first `mark`."""
        cost = Cost()
        for request in self._requests[mark:]:
            name = Opcode(request.opcode).name
            if name == KEEP_ALIVE:
                cost.keep_alives += 1
                continue
            cost.counts[SHORT[name]] += 1
            if name in ("READ_FILE", "WRITE_FILE"):
                cost.payload += request.size
        return cost


@dataclass
class Counting:
    """A mounted vehicle whose requests are counted."""

    vehicle: CountedVehicle
    mount: Mount
    retransmissions: int = 0

    @property
    def folder(self) -> Path:
        """Where on the mount files may be written."""
        return self.mount.path / FOLDERS.get(self.vehicle.profile, "") / ROOM

    def start(self) -> Cost:
        """Mount, and return what that cost."""
        self.mount.start()
        self.settle()
        return self.vehicle.cost_since(0)

    def run(self, case: Case) -> Cost:
        """Run a case in its directory."""
        where = self.folder / directory(case)
        scratch = self.mount.folder / where.name
        scratch.mkdir()
        listed = time.monotonic()
        self._bash(f"ls -l .. > /dev/null; {case.before}", where, scratch)
        self.settle()
        time.sleep(FREE_FOR + 0.1 if case.aged else 0)
        mark, repeated = self.vehicle.asked(), self.status()["link"]["retransmissions"]
        started = time.monotonic()
        self._bash(case.script, where, scratch)
        seconds = time.monotonic() - started
        late = not case.aged and time.monotonic() - listed > FREE_FOR
        self.settle()
        cost = self.vehicle.cost_since(mark)
        cost.seconds, cost.late = seconds, late
        cost.repeats = self.status()["link"]["retransmissions"] - repeated
        return cost

    def settle(self) -> None:
        """Wait until the mount is idle: nothing open, nothing to deliver, nothing asked."""
        deadline = time.monotonic() + SETTLING
        seen, since, quiet = -1, time.monotonic(), SETTLED
        while time.monotonic() - since < quiet:
            status = self.status()
            assert time.monotonic() < deadline, f"the mount does not come to rest: {status}"
            now = self.vehicle.asked()
            # A vehicle that had no time yet to take what was sent has not counted it.
            quiet = SETTLED if now >= status["link"]["requests"] else LOST
            # The mount's own word is not enough: a Terminate that comes later counts for the next case.
            if now != seen or not self._idle(status) or self.vehicle.sessions():
                seen, since = now, time.monotonic()
            time.sleep(0.05)

    @staticmethod
    def _idle(status: dict[str, dict[str, Any]]) -> bool:
        connection = status["connection"]
        waiting = status["cache"].get("files_undelivered")
        busy = connection["session_open"] is not None or connection["in_flight"]
        return not busy and not connection["uploads"] and not waiting

    def status(self) -> dict[str, dict[str, Any]]:
        """Return what the mount says of itself."""
        return self.mount.status()

    def _bash(self, script: str, where: Path, scratch: Path) -> None:
        self.mount.run("bash", "-c", PRELUDE + script, "bash", where, scratch)


def directory(case: Case) -> str:
    """Return the name of a case's directory."""
    return case.name.replace(" ", "_").replace("/", "_")


def prepare(root: Path, profile: str, cases: Sequence[Case]) -> None:
    """Fill a card with the directories of all cases."""
    for case in cases:
        folder = root / FOLDERS.get(profile, "") / ROOM / directory(case)
        folder.mkdir(parents=True)
        case.prepare(folder)
