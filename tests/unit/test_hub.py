"""The hub's pure parts: finding frames, where they go, which mount is next on the line."""

from __future__ import annotations

import pytest
from fastcrc import crc16

from mavftpfs.hub.outbox import LINE_TIME, LinePace, Outbox, Waiting
from mavftpfs.hub.routing import Kind, Router
from mavftpfs.hub.senders import MEMORY, MOST_SENDERS, PORT, Place
from mavftpfs.link.addresses import PATIENCE, NetAddress
from mavftpfs.link.fastframe import FTP_PAYLOAD_SIZE
from mavftpfs.link.frames import EVERYBODY, HEARTBEAT_ID, Frame, Splitter, armed_by
from mavftpfs.link.framing import Framer
from mavftpfs.link.messages import MAV_AUTOPILOT_INVALID, Address
from mavftpfs.sim.vehicle import telemetry

ONE, TWO = Address(1, 1), Address(2, 1)
STATION = Address(255, 190)
CLIENT, FAR = Address(254, 191), Address(9, 1)
AT_ONE, AT_TWO, AT_WEST = ("10.0.0.1", 14550), ("10.0.0.2", 14550), ("127.0.0.1", 40)
ELSEWHERE = ("10.0.0.66", 1)
EAST, WEST, MOUNT, OTHER = 1, 2, 3, 4


def parsed(data: bytes) -> Frame:
    """Return the one frame of a datagram."""
    (frame,) = Splitter(stream=False).feed(data)
    return frame


def beat(source: Address, *, autopilot: int = 12, armed: bool = False) -> Frame:
    return parsed(Framer(source, stream=False).encode_heartbeat(2, autopilot, 0x80 if armed else 0))


def hello(source: Address) -> Frame:
    """The heartbeat of what is no autopilot."""
    return beat(source, autopilot=MAV_AUTOPILOT_INVALID)


def ftp(source: Address, target: Address) -> Frame:
    return parsed(Framer(source, stream=False).encode_ftp(target, bytes([7]) * FTP_PAYLOAD_SIZE))


def attitude(source: Address) -> Frame:
    return parsed(Framer(source, stream=False).encode(*telemetry(0, 1000)))


def foreign(source: Address, number: int) -> bytes:
    """Return a frame of a dialect that nobody here knows."""
    payload = b"whatever"
    head = bytes((len(payload), 0, 0, 9, *source)) + number.to_bytes(3, "little")
    return b"\xfd" + head + payload + b"\x12\x34"


# -- frames ---------------------------------------------------------------------------------------


def test_of_a_frame_the_header_is_read_and_whom_it_is_for() -> None:
    frame = ftp(ONE, STATION)
    assert (frame.source, frame.target, frame.id, frame.crc_fits) == (ONE, STATION, 110, True)
    assert beat(ONE).target == EVERYBODY
    command = parsed(Framer(STATION, stream=False).encode_request_message(TWO, 148))
    assert (command.source, command.target, command.id) == (STATION, TWO, 76)
    cut = parsed(Framer(ONE, stream=False).encode_ftp(Address(7, 0), bytes(FTP_PAYLOAD_SIZE)))
    assert cut.target == Address(7, 0), "MAVLink 2 cuts zeros"


def test_what_a_stream_ended_in_counts_when_it_falls_silent() -> None:
    splitter = Splitter(stream=True)
    unknown = foreign(TWO, 777)
    assert splitter.feed(unknown) == []
    assert splitter.waiting
    assert [frame.data for frame in splitter.on_silence()] == [unknown]
    assert splitter.feed(b"\xfd\xff\x00") == []
    assert splitter.on_silence() == []
    assert not splitter.waiting


def test_zeros_that_were_cut_from_a_heartbeat_are_no_armed_vehicle() -> None:
    """The heartbeat's last fields are zeros, base_mode too. The bytes behind are the checksum."""
    for custom_mode in range(256):
        head = bytes((5, 0, 0, 0, *ONE, HEARTBEAT_ID, 0, 0))
        payload = custom_mode.to_bytes(4, "little") + b"\x02"
        crc = crc16.mcrf4xx(head + payload + bytes((50,)))  # 50: the message's extra byte
        frame = parsed(b"\xfd" + head + payload + crc.to_bytes(2, "little"))
        assert frame.crc_fits
        assert armed_by(frame) is False


def test_only_autopilots_are_armed() -> None:
    assert armed_by(beat(ONE, armed=True)) is True
    assert armed_by(beat(ONE)) is False
    assert armed_by(beat(STATION, autopilot=MAV_AUTOPILOT_INVALID, armed=True)) is None
    assert armed_by(attitude(ONE)) is None


# -- where they go --------------------------------------------------------------------------------


class Net:
    """A router with two endpoints and two clients, and a clock."""

    def __init__(self) -> None:
        self.now = 100.0
        self.router = Router()
        self.router.add(PORT, Kind.PORT, fixed=False)
        self.router.add(EAST, Kind.ENDPOINT, fixed=True)
        self.router.add(WEST, Kind.ENDPOINT, fixed=False)
        self.router.add(MOUNT, Kind.CLIENT)
        self.router.add(OTHER, Kind.CLIENT)
        self.to: dict[int, NetAddress] = {}

    def send(self, frame: Frame, side: int, address: NetAddress | None = None) -> set[Place]:
        """Return where a frame goes; each place gets it once."""
        places = self.router.route(frame, Place(side, address), self.now, self.to.get(side))
        assert len(set(places)) == len(places)
        return set(places)

    def sides(self, frame: Frame, side: int, address: NetAddress | None = None) -> set[int]:
        """Return the sides that a frame goes to."""
        return {place.side for place in self.send(frame, side, address)}


@pytest.fixture
def net() -> Net:
    """Two vehicles on the port, a ground station at each endpoint; each client has asked its vehicle."""
    net = Net()
    net.send(beat(ONE), PORT, AT_ONE)
    net.send(beat(TWO), PORT, AT_TWO)
    net.send(hello(STATION), EAST)
    net.send(hello(Address(255, 191)), WEST, AT_WEST)
    for side, component, system in ((MOUNT, 191, 1), (OTHER, 192, 2)):
        own = Address(254, component)
        net.send(hello(own), side)
        net.to[side] = AT_ONE if system == 1 else AT_TWO
        net.send(parsed(Framer(own, stream=False).encode_request_message(Address(system, 1), 148)), side)
    net.now += 1
    return net


TO_ONE, TO_TWO, TO_WEST = Place(PORT, AT_ONE), Place(PORT, AT_TWO), Place(WEST, AT_WEST)
TO_EAST, TO_MOUNT, TO_OTHER = (Place(side, None) for side in (EAST, MOUNT, OTHER))


ROUTES: dict[str, tuple[Frame, int, NetAddress | None, set[Place]]] = {
    "telemetry": (attitude(ONE), PORT, AT_ONE, {TO_EAST, TO_WEST, TO_MOUNT}),
    "an answer to a station": (ftp(ONE, STATION), PORT, AT_ONE, {TO_EAST, TO_MOUNT}),
    "an answer to a client": (ftp(ONE, CLIENT), PORT, AT_ONE, {TO_MOUNT}),
    "a station asks a vehicle": (ftp(STATION, TWO), EAST, None, {TO_TWO, TO_OTHER}),
    "a client asks its vehicle": (ftp(CLIENT, ONE), MOUNT, None, {TO_ONE}),
    "a station's heartbeat": (hello(STATION), EAST, None, {TO_ONE, TO_TWO, TO_WEST, TO_MOUNT, TO_OTHER}),
    "a station's telemetry": (attitude(STATION), EAST, None, {TO_ONE, TO_TWO, TO_WEST}),
    "a client's heartbeat": (hello(CLIENT), MOUNT, None, {TO_ONE}),
    "the vehicle by an endpoint": (attitude(ONE), EAST, None, set()),
    "the station by the port": (hello(STATION), PORT, ELSEWHERE, set()),
    "a client by the port": (hello(CLIENT), PORT, AT_ONE, set()),
    "another vehicle at an endpoint": (beat(FAR), WEST, AT_WEST, {TO_ONE, TO_TWO, TO_EAST}),
    "it asks ours": (ftp(FAR, ONE), WEST, AT_WEST, {TO_ONE, TO_MOUNT}),
    "one vehicle asks the other": (ftp(ONE, TWO), PORT, AT_ONE, {TO_MOUNT, TO_OTHER}),
}


@pytest.mark.parametrize("what", ROUTES)
def test_where_a_frame_goes(net: Net, what: str) -> None:
    frame, side, address, places = ROUTES[what]
    assert net.send(frame, side, address) == places


def test_a_client_whose_vehicle_was_not_heard_yet_speaks_to_all(net: Net) -> None:
    del net.to[MOUNT]
    assert net.send(hello(CLIENT), MOUNT) == {TO_ONE, TO_TWO}


def test_a_client_that_names_no_vehicle_is_told_only_the_heartbeats_of_all(net: Net) -> None:
    net.router.remove(OTHER)
    net.router.add(OTHER, Kind.CLIENT)
    net.send(hello(Address(254, 192)), OTHER)
    assert OTHER not in net.sides(ftp(ONE, EVERYBODY), PORT, AT_ONE)
    assert OTHER not in net.sides(attitude(ONE), PORT, AT_ONE)
    assert OTHER in net.sides(beat(ONE), PORT, AT_ONE)


@pytest.mark.holds("promise 1")
def test_a_second_sender_of_one_id_reaches_no_endpoint_and_is_said(net: Net) -> None:
    assert net.sides(ftp(ONE, STATION), PORT, ELSEWHERE) == {MOUNT}, "which judges for itself"
    assert net.router.senders.doubles() == {}, "it may have moved"
    net.now += 0.1
    net.send(attitude(ONE), PORT, AT_ONE)
    assert net.router.senders.doubles() == {ONE: ELSEWHERE}
    assert net.send(ftp(STATION, ONE), EAST) >= {Place(PORT, AT_ONE)}
    net.now += PATIENCE + 1
    assert EAST in net.sides(attitude(ONE), PORT, ELSEWHERE), "the first one fell silent"
    assert net.router.senders.doubles() == {}


def test_what_cannot_be_proven_passes_on_its_way_but_teaches_nothing(net: Net) -> None:
    data = bytearray(beat(ONE, armed=True).data)
    data[-1] ^= 1
    for frame in (parsed(bytes(data)), parsed(foreign(ONE, 54_321))):
        assert not frame.crc_fits
        assert EAST in net.sides(frame, PORT, AT_ONE)
    assert not net.router.armed[1]
    for place in ((PORT, AT_TWO), (WEST, AT_WEST)):
        assert net.sides(parsed(foreign(FAR, 54_321)), *place) == set()
    assert FAR not in net.router.senders


def made_up(number: int) -> Address:
    return Address(10 + number % 240, 1 + number // 240)


@pytest.mark.holds("promise 1")
def test_made_up_senders_on_the_port_take_no_vehicles_place_and_do_not_go_round(net: Net) -> None:
    passed = 0
    for number in range(3 * MOST_SENDERS):
        frame = attitude(made_up(number))
        if net.sides(frame, PORT, ELSEWHERE):
            passed += 1
            assert not net.send(frame, PORT, AT_TWO) & {TO_EAST, TO_WEST}, "it was sent back by a router"
        net.now += 0.001
    assert passed < MOST_SENDERS
    assert EAST not in net.sides(attitude(ONE), PORT, ELSEWHERE)
    assert EAST in net.sides(attitude(ONE), PORT, AT_ONE)
    net.now += PATIENCE + 1
    assert EAST in net.sides(attitude(FAR), PORT, AT_TWO), "room for a new one when they fell silent"


def test_frames_for_all_go_no_longer_where_a_station_was_before(net: Net) -> None:
    station = Address(255, 191)
    for number in range(5):
        net.now += MEMORY + 1
        assert net.sides(hello(station), WEST, ("127.0.0.1", 50 + number))
    net.send(attitude(ONE), PORT, AT_ONE)
    assert {place for place in net.send(attitude(ONE), PORT, AT_ONE) if place.side == WEST} == {
        Place(WEST, ("127.0.0.1", 54))
    }


def test_who_left_is_forgotten(net: Net) -> None:
    net.router.remove(EAST)
    assert EAST not in net.sides(ftp(ONE, STATION), PORT, AT_ONE)
    assert STATION not in net.router.senders


# -- which mount is next --------------------------------------------------------------------------


def waiting(text: str) -> Waiting:
    return Waiting(Place(PORT, None), text.encode())


def test_a_side_that_floods_loses_its_own_frames() -> None:
    outbox = Outbox(10)
    for _ in range(100):
        outbox.push(EAST, waiting("12345"))
    outbox.push(MOUNT, waiting("mine"))
    assert [outbox.pop().frame for _ in range(3)] == [b"12345", b"mine", b"12345"]
    assert not outbox


def test_a_serial_line_is_given_50_ms_ahead() -> None:
    line = LinePace(57600)
    now, given = 10.0, 0
    while line.ready_at() <= now:
        line.sent(266, now)
        given += 266
    assert LINE_TIME * 5760 <= given <= LINE_TIME * 5760 + 266
    assert line.ready_at() == pytest.approx(now + given / 5760 - LINE_TIME)
    assert LinePace(None).ready_at() <= 0
