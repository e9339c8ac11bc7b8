"""Several programs of ours on one port: through the hub, which nobody has to configure."""

from __future__ import annotations

import json
import os
import re
import signal
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from tests.mount.conftest import Field
from tests.support.mounts import Mount, command, hub_of, mavftpfs, wait_until
from tests.support.places import FOLDERS, start_place
from tests.support.vehicles import HOST, free_udp_port

CONTENT = bytes(range(256)) * 400
BEGINNING = (r"the hub of .* is gone",)


def card(field: Field, name: str) -> Path:
    """Return a card with one file, which says whose it is."""
    root = field.local(name)
    (root / "log.bin").write_bytes(name.encode() + CONTENT)
    return root


def two_vehicles(field: Field) -> tuple[list[Path], str]:
    """Start two vehicles of other kinds that send to one port; return their cards and the SOURCE."""
    port = free_udp_port()
    cards = [card(field, "first"), card(field, "second")]
    for number, (root, profile) in enumerate(zip(cards, ("px4", "ardupilot5"), strict=True), 1):
        options = ("--system", str(number), "--seed", str(number))
        field.sim(root, profile, options, link=f"udpout:{HOST}:{port}")
    return cards, f"udpin:{HOST}:{port}"


def reads_right(mount: Mount, root: Path) -> bool:
    """Return whether a file is read anew, and right."""
    command("ls", mount.path)
    return mount.read_bytes(mount.path / "log.bin") == (root / "log.bin").read_bytes()


def test_two_mounts_and_commands_share_a_port_that_nobody_configured(field: Field) -> None:
    cards, source = two_vehicles(field)
    one = field.mount(source, "target_system=1")
    assert hub_of(source) is None, "a mount alone has its port itself"
    found = json.loads(command("scan", "--json", source)[0])
    assert {entry["system"] for entry in found if entry["answers"]} == {1, 2}
    two = field.mount(source, "target_system=2")
    listed = command("ls", source, "/", "-o", "target_system=2")[0]
    assert "log.bin" in listed
    shown = command("hub", source)[0]
    assert f"{source}: shared by 2" in shown
    assert len(set(re.findall(r" as (\d+/\d+)$", shown, re.MULTILINE))) == 2
    heard = two.status()["link"]["received_bytes"]
    assert reads_right(one, cards[0])
    assert two.status()["link"]["received_bytes"] - heard < len(CONTENT) / 2, "not what others get"
    for mount, root in ((one, cards[0]), (two, cards[1])):
        assert reads_right(mount, root)
        mount.run("cp", root / "log.bin", mount.path / "copy.bin")
        assert (root / "copy.bin").read_bytes() == (root / "log.bin").read_bytes()
    assert one.unmount() == 0
    assert reads_right(two, cards[1]), "the hub goes on for the other one"
    assert two.unmount() == 0
    wait_until("the hub ended with its last client", lambda: hub_of(source) is None)


@pytest.mark.parametrize("kind", ["px4", "px4-nuttx", "ardupilot", "mavsdk"])
def test_an_upload_goes_on_when_a_second_program_comes(field: Field, kind: str) -> None:
    place = start_place(field, kind, ("--rate", "15000"))
    source = place.vehicle.source
    mount = field.mount(source)
    (mount.folder / "new").write_bytes(CONTENT)
    target = mount.path / FOLDERS[kind] / "new"
    with mount.started("cp", mount.folder / "new", target) as copying:
        wait_until("the upload began", lambda: any(mount.status()["connection"]["uploads"]))
        command("scan", source)
        assert mount.status()["link"]["reopened"] == 1
        assert copying.wait(60) == 0
    assert (place.card / "new").read_bytes() == CONTENT


@pytest.mark.holds("promise 6")
def test_commands_at_once_wait_for_each_other_where_there_is_one_session(field: Field) -> None:
    """ArduPilot refuses the others while one reads. To each, the others are other clients. They are heard, so
    they are waited for longer than `op_deadline`."""
    root, got, names = field.local("card"), field.local("got"), [f"f{number}" for number in range(3)]
    for number, name in enumerate(names):
        (root / name).write_bytes(bytes([number]) + CONTENT * 8)
    source = f"udpin:{HOST}:{free_udp_port()}"
    field.sim(root, "ardupilot", link=source.replace("udpin", "udpout"))
    get = ("get", "-o", "op_deadline=6", source)
    with ThreadPoolExecutor(len(names)) as programs:
        running = [programs.submit(mavftpfs, *get, f"/{name}", "--to", got / name) for name in names]
        for one in running:
            one.result()
    for name in names:
        assert (got / name).read_bytes() == (root / name).read_bytes()


def kill_hub(source: str, mounts: list[Mount]) -> None:
    for mount in mounts:
        mount.allowed_log += BEGINNING
    facts = hub_of(source)
    assert facts is not None
    os.kill(facts["pid"], signal.SIGKILL)


def test_a_killed_hub_is_started_again_and_no_write_is_lost(field: Field) -> None:
    cards, source = two_vehicles(field)
    mounts = [field.mount(source, f"target_system={number}") for number in (1, 2)]
    written: list[tuple[Path, bytes]] = []
    copy = field.local("copies") / "log.bin"
    with mounts[0].started("cp", mounts[0].path / "log.bin", copy) as reading:
        for turn in range(2):
            kill_hub(source, mounts)
            for mount, root in zip(mounts, cards, strict=True):
                data = f"{turn} {root.name}".encode() * 500
                name = f"turn{turn}"
                code = "import sys; open(sys.argv[1], 'wb').write(bytes.fromhex(sys.argv[2]))"
                mount.python(code, mount.path / name, data.hex())
                written.append((root / name, data))
            time.sleep(0.2)
        assert reading.wait(60) == 0
    assert copy.read_bytes() == (cards[0] / "log.bin").read_bytes()
    assert [path.read_bytes() for path, _ in written] == [data for _, data in written]
    for mount, root in zip(mounts, cards, strict=True):
        assert reads_right(mount, root)


@pytest.mark.parametrize("link", ["pty", "tcpin"])
def test_streams_are_shared_too(field: Field, link: str) -> None:
    root = field.local("card")
    (root / "log.bin").write_bytes(CONTENT[:20_000])
    place = "pty" if link == "pty" else f"tcpin:{HOST}:{free_udp_port()}"
    vehicle = field.sim(root, "px4", link=place)
    source = vehicle.source
    one = field.mount(source)
    two = field.mount(source)
    for mount in (one, two):
        mount.run("cp", root / "log.bin", mount.path / f"{mount.folder.name}.bin")
        assert (root / f"{mount.folder.name}.bin").read_bytes() == (root / "log.bin").read_bytes()
    assert hub_of(source) is not None
    kill_hub(source, [one, two])
    for mount in (one, two):
        wait_until("it reads again", reading_again(mount, root))


def reading_again(mount: Mount, root: Path) -> Callable[[], bool]:
    return lambda: reads_right(mount, root)
