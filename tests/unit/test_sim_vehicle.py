"""The simulated vehicle around its FTP server."""

from __future__ import annotations

import random
from typing import TypeVar

import pytest

from mavftpfs.link.framing import STORAGE_INFORMATION_ID, Framer
from mavftpfs.link.messages import (
    Address,
    FtpRun,
    Heartbeat,
    Message,
    StorageInformation,
    SystemTime,
)
from mavftpfs.protocol.payload import Opcode
from mavftpfs.sim.profiles import PROFILES
from mavftpfs.sim.tree import MemoryTree
from mavftpfs.sim.vehicle import SimVehicle
from tests.support.frames import feed
from tests.support.replies import decode_reply, request

T = TypeVar("T")
US = Address(254, 191)
DRONE = Address(1, 1)
LIST = request(5, Opcode.LIST_DIRECTORY, data=b"/").encode()


class Client:
    """The other end: talks to one vehicle, on hand-made time."""

    def __init__(self, profile: str = "px4", **options: object) -> None:
        self.vehicle = SimVehicle(
            MemoryTree(),
            PROFILES[profile],
            rng=random.Random(1),
            **options,  # type: ignore[arg-type]
        )
        self.framer = Framer(US, stream=False)
        self.now = 100.0

    def hear(self, seconds: float = 0.0) -> list[Message]:
        """Return all that the vehicle says until so much later."""
        found: list[Message] = []
        end = self.now + seconds
        for _ in range(100_000):
            due = self.vehicle.next_deadline()
            if due > end:
                self.now = end
                return found
            self.now = max(self.now, due)
            for frame in self.vehicle.outgoing(self.now):
                found += feed(self.framer, frame)
        raise AssertionError("the vehicle never comes to rest")

    def tell(self, frame: bytes) -> None:
        self.vehicle.receive(frame, self.now)

    def ftp(self, target: Address = DRONE) -> list[FtpRun]:
        """Ask for a listing and return the FTP frames that come back within a second."""
        self.tell(self.framer.encode_ftp(target, LIST))
        return [m for m in self.hear(0.9) if isinstance(m, FtpRun)]


def of(kind: type[T], messages: list[Message]) -> list[T]:
    return [m for m in messages if isinstance(m, kind)]


@pytest.mark.parametrize(
    ("profile", "target", "answers"),
    [
        ("px4", Address(1, 1), True),
        ("px4", Address(1, 0), True),
        ("px4", Address(0, 0), True),
        ("px4", Address(0, 1), True),
        ("px4", Address(1, 100), False),
        ("px4", Address(2, 1), False),
        ("ardupilot", Address(1, 100), True),
        ("ardupilot", Address(2, 1), False),
        ("mavsdk", Address(1, 100), False),
    ],
)
def test_answers_requests_meant_for_it(profile: str, target: Address, answers: bool) -> None:
    client = Client(profile)
    replies = client.ftp(target)
    assert [(r.source, r.target) for r in replies] == ([(DRONE, US)] if answers else [])
    if answers:
        assert decode_reply(replies[0].payloads[0]).req_opcode == Opcode.LIST_DIRECTORY


def test_reboot_loses_time_arming_and_sessions_but_no_files() -> None:
    client = Client("px4", armed=True)
    client.vehicle.server.tree.open(b"/a", write=True, create=True).close()
    client.tell(client.framer.encode_ftp(DRONE, request(1, Opcode.OPEN_FILE_RO, data=b"/a").encode()))
    client.hear(5)
    assert client.vehicle.server.open_sessions == 1
    client.vehicle.reboot(client.now, downtime=3.0)
    client.tell(client.framer.encode_ftp(DRONE, LIST))
    assert client.vehicle.outgoing(client.now) == []
    assert client.hear(2.9) == []
    heard = client.hear(0.2)
    assert of(FtpRun, heard) == []
    assert of(SystemTime, heard)[0].time_boot_ms == 3000
    assert not of(Heartbeat, heard)[0].armed
    assert client.vehicle.server.open_sessions == 0
    assert len(client.ftp()) == 1
    assert client.vehicle.server.tree.stat(b"/a").size == 0


def test_another_ground_station_is_heard_with_its_answers() -> None:
    client = Client()
    client.hear()
    gcs = Address(255, 190)
    client.vehicle.foreign_request(LIST, gcs, client.now)
    heard = of(FtpRun, client.hear(0.5))
    assert [(f.source, f.target) for f in heard] == [(gcs, DRONE), (DRONE, gcs)]
    client.vehicle.foreign_request(LIST, gcs, client.now, audible=False)
    assert [(f.source, f.target) for f in of(FtpRun, client.hear(0.5))] == [(DRONE, gcs)]


@pytest.mark.parametrize(("client", "told"), [(Client("px4"), 1), (Client("mavsdk"), 0)])
def test_the_size_of_the_card_is_told_by_autopilots(client: Client, told: int) -> None:
    client.tell(client.framer.encode_request_message(DRONE, STORAGE_INFORMATION_ID))
    assert len(of(StorageInformation, client.hear())) == told


def test_two_vehicles_of_one_seed_are_told_apart() -> None:
    first, second = Client(), Client(address=Address(2, 1))
    assert first.vehicle._uid != second.vehicle._uid
    heard = [message for message in second.hear(1.5) if isinstance(message, Heartbeat)]
    assert {message.source for message in heard} == {Address(2, 1)}
