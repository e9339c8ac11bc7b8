"""Ground stations beside a mount, on the same port: `forward=`, with real ones."""

from __future__ import annotations

import json
import random
import socket
import time
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import pytest

from mavftpfs.link.frames import Frame, Splitter
from mavftpfs.link.framing import Framer
from mavftpfs.link.messages import MAV_AUTOPILOT_INVALID, MAV_TYPE_GCS, Address
from tests.mount.conftest import Field
from tests.support.flown import PARAMETERS
from tests.support.mounts import Mount, command, hub_of, wait_until
from tests.support.neighbours import Neighbour
from tests.support.vehicles import HOST, Process, Program, free_udp_port

CONTENT = random.Random(1).randbytes(15_000)
OURS = 254
KEY = bytes(range(32))
STATION = Address(255, 190)


class Flown(Program):
    """A vehicle that a ground station can fly, with a log on its card. record: each frame on its link."""

    def __init__(self, field: Field, *options: str, link: str = "") -> None:
        folder, self.root = field.local("vehicle"), field.local("card")
        (self.root / "log.bin").write_bytes(CONTENT)
        self.record = folder / "frames"
        link = link or f"udpout:{HOST}:{free_udp_port()}"
        words = ["--link", link, "--record", str(self.record), "--telemetry", "1000", *options]
        argv = ["tests.support.flown", str(self.root), *words]
        super().__init__("flown", argv, folder)
        field.own(self)
        wait_until("the vehicle speaks", lambda: bool(self.output.read_text()))
        self.source = self.output.read_text().split()[1]


class Station(Program):
    """A real ground station."""

    def __init__(self, field: Field, port: int, *words: str, program: str = "station") -> None:
        folder = field.local("station")
        self.record = folder / "frames"
        argv = [f"tests.support.{program}", str(port), *words]
        if program == "station":
            argv += ["--record", str(self.record)]
        super().__init__(program, argv, folder)
        field.own(self)
        wait_until("the station listens", lambda: "ready" in self.output.read_text())

    def results(self) -> Any:
        """Wait for its end; return what it got."""
        assert self.wait(200) == 0, self.text()
        return json.loads(self.output.read_text().splitlines()[-1])


def recorded(path: Path, mark: str) -> list[Frame]:
    """Return the frames of a record that went one way."""
    lines = [line.split() for line in path.read_text().splitlines()]
    datagrams = [bytes.fromhex(line[1]) for line in lines if len(line) == 2 and line[0] == mark]
    return [frame for datagram in datagrams for frame in Splitter(stream=False).feed(datagram)]


def assert_passed_on(sent: list[Frame], got: list[Frame], least: int) -> None:
    """Check that all that was sent arrived, unchanged and in order, from the first that arrived on."""
    assert len(got) >= least
    first = next(index for index, frame in enumerate(sent) if frame.data == got[0].data)
    expected = [frame.data for frame in sent[first : first + len(got)]]
    assert [frame.data for frame in got] == expected


def forwarded(port: int) -> str:
    return f"forward=udpout:{HOST}:{port}"


def work_on(mount: Mount, root: Path, station: Process) -> None:
    """Copy files to and from the vehicle as long as a station works."""
    turns = 0
    while station.running or turns == 0:
        turns += 1
        local = mount.folder / f"copy{turns}"
        mount.run("cp", mount.path / "log.bin", local)
        assert local.read_bytes() == CONTENT
        data = CONTENT[turns : turns + 8000]
        (mount.folder / "up").write_bytes(data)
        mount.run("cp", mount.folder / "up", mount.path / f"up{turns}")
        assert (root / f"up{turns}").read_bytes() == data
        (root / "log.bin").touch()  # so that it is read anew


@pytest.mark.parametrize("kind", ["pty", "udp"])
def test_a_station_works_beside_the_mount_and_each_frame_passes_unchanged(field: Field, kind: str) -> None:
    port = free_udp_port()
    station = Station(field, port)
    flown = Flown(field, "--rate", "5760", link="pty") if kind == "pty" else Flown(field)
    mount = field.mount(flown.source, forwarded(port), "dir_timeout=0")
    work_on(mount, flown.root, station)
    assert station.results() == PARAMETERS
    assert mount.unmount() == 0
    assert flown.stop() == 0
    heard = recorded(station.record, "<")
    sent = [frame for frame in recorded(flown.record, ">") if frame.target.system != OURS]
    assert_passed_on(sent, heard, 50)
    said = recorded(station.record, ">")
    came = [frame for frame in recorded(flown.record, "<") if frame.source.system != OURS]
    assert [frame.data for frame in said] == [frame.data for frame in came]
    assert [frame.target.system for frame in heard].count(OURS) == 0


def test_mavsdk_works_beside_the_mount(field: Field) -> None:
    port = free_udp_port()
    station = Station(field, port, program="mavsdk_station")
    flown = Flown(field)
    mount = field.mount(flown.source, forwarded(port), "dir_timeout=0")
    work_on(mount, flown.root, station)
    results = station.results()
    assert results["parameters"] == PARAMETERS
    assert results["attitudes"] >= 10


def test_signed_frames_pass_unchanged(field: Field) -> None:
    port = free_udp_port()
    key = field.local("key") / "key"
    key.write_bytes(KEY)
    key.chmod(0o600)
    station = Station(field, port, "--key", KEY.hex())
    flown = Flown(field, "--key", KEY.hex())
    mount = field.mount(flown.source, forwarded(port), f"signing_key={key}", "dir_timeout=0")
    second = field.mount(flown.source, f"signing_key={key}", "dir_timeout=0")
    work_on(mount, flown.root, station)
    assert station.results() == PARAMETERS
    assert second.read_bytes(second.path / "log.bin") == CONTENT
    assert [one.unmount() for one in (mount, second)] == [0, 0]
    assert flown.stop() == 0
    signed = [frame for frame in recorded(flown.record, "<") if frame.source.system == OURS]
    links = {frame.source.component: frame.data[-13] for frame in signed}
    assert len(links) == 2
    assert len(set(links.values())) == 2, "each of ours has a link id of its own"
    sent = [frame for frame in recorded(flown.record, ">") if frame.target.system != OURS]
    assert_passed_on(sent, recorded(station.record, "<"), 50)


# -- stations that do harm --------------------------------------------------------------------------


class Pest(Neighbour):
    """An endpoint of the mount that floods it with what it likes."""

    def __init__(self, port: int, datagram: bytes) -> None:
        super().__init__(port, 30)
        self._datagram = datagram

    def _run(self) -> None:
        _, hub = self._sock.recvfrom(2048)
        while not self._over.is_set():
            with suppress(OSError):
                self._sock.sendto(self._datagram, hub)
                self.sent += 1
            if self.sent % 5 == 0:
                time.sleep(0.002)  # about 2500 a second


def test_endpoints_that_flood_harm_nobody(field: Field) -> None:
    other = free_udp_port()
    station = Framer(STATION, stream=False)
    floods = [
        station.encode("attitude", 1, 0.1, 0.2, 0.3, 0, 0, 0),
        random.Random(2).randbytes(900),
        Framer(Address(1, 1), stream=False).encode_ftp(Address(OURS, 191), bytes([5] * 251)),
        station.encode_heartbeat(MAV_TYPE_GCS, MAV_AUTOPILOT_INVALID),
    ]
    ports = [free_udp_port() for _ in floods]
    work = Station(field, other)
    flown = Flown(field)
    with ExitStack() as stack:
        pests = [stack.enter_context(Pest(*pest)) for pest in zip(ports, floods, strict=True)]
        mount = field.mount(flown.source, *map(forwarded, [*ports, other]), "dir_timeout=0")
        work_on(mount, flown.root, work)
        assert work.results() == PARAMETERS
        assert all(pest.sent > 1000 for pest in pests)


def test_two_stations_with_one_id_both_work(field: Field) -> None:
    ports = [free_udp_port(), free_udp_port()]
    flown = Flown(field)
    stations = [Station(field, port) for port in ports]
    mount = field.mount(flown.source, *map(forwarded, ports), "dir_timeout=0")
    for station in stations:
        work_on(mount, flown.root, station)
        assert station.results() == PARAMETERS


# -- the end of the mount ---------------------------------------------------------------------------


class Listener(Neighbour):
    """A ground station that only listens and sends heartbeats; notes when the vehicle's heartbeats came."""

    def __init__(self, port: int) -> None:
        super().__init__(port)
        self.beats: list[float] = []

    def _run(self) -> None:
        framer = Framer(STATION, stream=False)
        told = 0.0
        while not self._over.is_set():
            with suppress(TimeoutError):
                data, hub = self._sock.recvfrom(65536)
                frames = Splitter(stream=False).feed(data)
                self.beats += [
                    time.monotonic() for frame in frames if frame.id == 0 and frame.source.system == 1
                ]
                if time.monotonic() - told > 0.5:
                    told = time.monotonic()
                    self._sock.sendto(framer.encode_heartbeat(MAV_TYPE_GCS, MAV_AUTOPILOT_INVALID), hub)


@pytest.mark.parametrize("way", ["umount", "kill"])
def test_in_flight_the_stations_link_outlives_the_mount(field: Field, way: str) -> None:
    port = free_udp_port()
    flown = Flown(field, "--armed")
    with Listener(port) as listener:
        mount = field.mount(flown.source, forwarded(port))
        wait_until("the station hears the vehicle", lambda: len(listener.beats) > 2)
        if way == "umount":
            assert mount.unmount() == 0
        else:
            mount.kill()
            command("umount", mount.path)
        until = len(listener.beats) + 4
        wait_until("the station hears it on", lambda: len(listener.beats) >= until)
        facts = hub_of(flown.source)
        assert facts is not None
        assert facts["armed"] == [1]
        said, _ = command("hub", "--stop", flown.source, code=1)
        assert "ARMED" in said
        assert f"udpout:{HOST}:{port}" in said
        again = field.mount(flown.source)
        assert again.read_bytes(again.path / "log.bin") == CONTENT
        assert again.unmount() == 0
        gaps = [after - before for before, after in zip(listener.beats, listener.beats[1:], strict=False)]
        assert len(gaps) >= 6
        assert sorted(gaps)[len(gaps) // 2] < 2, gaps
        command("hub", "--stop", "--force", flown.source)
    wait_until("the hub is gone", lambda: hub_of(flown.source) is None)


def test_on_the_ground_the_hub_ends_with_the_mount(field: Field) -> None:
    port = free_udp_port()
    flown = Flown(field)
    with Listener(port) as listener:
        mount = field.mount(flown.source, forwarded(port))
        wait_until("the station hears the vehicle", lambda: len(listener.beats) > 1)
        assert mount.unmount() == 0
        wait_until("the hub ended", lambda: hub_of(flown.source) is None)


# -- what cannot be ---------------------------------------------------------------------------------


def test_endpoints_that_cannot_be_are_said_in_a_line(field: Field) -> None:
    flown = Flown(field)
    place = field.local("place")
    taken = free_udp_port()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind((HOST, taken))
        for option, code, said in (
            (f"forward={flown.source}", 1, "is SOURCE itself"),
            (f"forward=udpout:{HOST}:{flown.source.rpartition(':')[2]}", 1, "is SOURCE itself"),
            (f"forward=udpin:{HOST}:{taken}", 2, "is in use by another program"),
            ("forward=serial:///dev/nowhere:57600", 2, "there is no /dev/nowhere"),
            ("forward=nonsense", 1, "forward=nonsense"),
            (f"forward=udpout:{HOST}:{taken}#/dir", 1, "cannot name a directory"),
        ):
            failing = Mount(flown.source, place, field.local("out"), (option,))
            process = Program("mount", failing.argv(), failing.folder)
            assert process.wait() == code, (option, process.text())
            (line,) = process.text().splitlines()
            assert said in line
        mount = field.mount(flown.source, f"forward=udpin::{free_udp_port()}")
        assert "udpin:127.0.0.1:" in command("hub", flown.source)[0]
        assert mount.read_bytes(mount.path / "log.bin") == CONTENT
