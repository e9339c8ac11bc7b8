"""mavftpfs.connect: names, errors, many files; and a mount that is used in place of a connection."""

from __future__ import annotations

import errno
import os
import pickle
import resource
import socket
import threading
from array import array
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy
import pytest

import mavftpfs
from mavftpfs.api.errors import os_error
from mavftpfs.api.params import Params
from mavftpfs.client.selection import latest_in
from mavftpfs.protocol.payload import crc32
from mavftpfs.shared import errors
from mavftpfs.shared.errors import VehicleLost
from tests.mount.conftest import Field
from tests.support.mounts import wait_until
from tests.support.trees import content
from tests.support.vehicles import HOST, SimVehicle, free_udp_port

DATA = content("f", 70_000)
Call = Callable[[Any, str], object]


class Local:
    """A local directory with the same methods."""

    stat, listdir, rmdir = staticmethod(os.stat), staticmethod(os.listdir), staticmethod(os.rmdir)
    remove, rename, truncate = staticmethod(os.remove), staticmethod(os.rename), staticmethod(os.truncate)

    open = staticmethod(open)

    def mkdir(self, path: str, *, parents: bool = False, exist_ok: bool = False) -> None:
        Path(path).mkdir(parents=parents, exist_ok=exist_ok)

    exists, is_dir, is_file = map(staticmethod, (os.path.exists, os.path.isdir, os.path.isfile))

    def read_text(self, path: str) -> str:
        with open(path) as file:
            return file.read()

    def write_text(self, path: str, text: str) -> None:
        with open(path, "w") as file:
            file.write(text)

    def read_bytes(self, path: str) -> bytes:
        with open(path, "rb") as file:
            return file.read()

    def write_bytes(self, path: str, data: bytes) -> None:
        with open(path, "wb") as file:
            file.write(data)


CALLS: dict[str, Call] = {
    "list": lambda on, d: sorted(on.listdir(d)),
    "list a file": lambda on, d: on.listdir(d + "/a"),
    "list nothing": lambda on, d: on.listdir(d + "/nothing"),
    "sizes": lambda on, d: (on.stat(d + "/a") is None, on.is_dir(d + "/e"), on.is_file(d + "/e")),
    "stat nothing": lambda on, d: on.stat(d + "/nothing"),
    "stat through a file": lambda on, d: on.stat(d + "/a/b"),
    "exists": lambda on, d: [on.exists(d + name) for name in ("", "/a", "/nothing", "/a/b", "/e/")],
    "mkdir": lambda on, d: (on.mkdir(d + "/n"), on.is_dir(d + "/n")),
    "mkdir there": lambda on, d: on.mkdir(d + "/e"),
    "mkdir there, and fine": lambda on, d: on.mkdir(d + "/e", exist_ok=True),
    "mkdir over a file": lambda on, d: on.mkdir(d + "/a", exist_ok=True),
    "mkdir below nothing": lambda on, d: on.mkdir(d + "/n/n"),
    "mkdir with parents": lambda on, d: on.mkdir(d + "/n/m/o", parents=True),
    "rmdir": lambda on, d: on.rmdir(d + "/e"),
    "rmdir full": lambda on, d: on.rmdir(d),
    "rmdir a file": lambda on, d: on.rmdir(d + "/a"),
    "rmdir nothing": lambda on, d: on.rmdir(d + "/nothing"),
    "remove": lambda on, d: on.remove(d + "/a"),
    "remove a directory": lambda on, d: on.remove(d + "/e"),
    "remove nothing": lambda on, d: on.remove(d + "/nothing"),
    "rename": lambda on, d: on.rename(d + "/a", d + "/n"),
    "rename over": lambda on, d: on.rename(d + "/a", d + "/b"),
    "rename nothing": lambda on, d: on.rename(d + "/nothing", d + "/n"),
    "rename below nothing": lambda on, d: on.rename(d + "/a", d + "/nothing/n"),
    "rename over a directory": lambda on, d: on.rename(d + "/a", d + "/e"),
    "rename a directory": lambda on, d: on.rename(d + "/e", d + "/n"),
    "rename into itself": lambda on, d: on.rename(d + "/e", d + "/e/e"),
    "truncate": lambda on, d: on.truncate(d + "/a", 3),
    "extend": lambda on, d: on.truncate(d + "/a", 10),
    "truncate below zero": lambda on, d: on.truncate(d + "/a", -1),
    "truncate nothing": lambda on, d: on.truncate(d + "/nothing", 3),
    "text": lambda on, d: (on.write_text(d + "/n", "größe"), on.read_text(d + "/n")),
    "bytes": lambda on, d: (on.write_bytes(d + "/a", DATA), on.read_bytes(d + "/a") == DATA),
    "an array": lambda on, d: (on.write_bytes(d + "/n", array("i", [1, 2])), on.read_bytes(d + "/n")),
    "read nothing": lambda on, d: on.read_bytes(d + "/nothing"),
    "read a directory": lambda on, d: on.read_bytes(d + "/e"),
    "open a directory": lambda on, d: on.open(d + "/e").close(),
    "write a directory": lambda on, d: on.write_bytes(d + "/e", b""),
    "write below nothing": lambda on, d: on.write_bytes(d + "/nothing/n", b""),
    "exists, with a slash": lambda on, d: [on.exists(d + name) for name in ("/a/", "/e/", "/nothing/")],
    "a file, with a slash": lambda on, d: (on.is_file(d + "/a/"), on.is_dir(d + "/a/")),
    "stat a file, with a slash": lambda on, d: on.stat(d + "/a/"),
    "stat nothing, with a slash": lambda on, d: on.stat(d + "/nothing/"),
    "remove a file, with a slash": lambda on, d: on.remove(d + "/a/"),
    "remove a directory, with a slash": lambda on, d: on.remove(d + "/e/"),
    "rename a file, with a slash": lambda on, d: on.rename(d + "/a/", d + "/n"),
    "rename a file to a slash": lambda on, d: on.rename(d + "/a", d + "/n/"),
    "rename a directory to a slash": lambda on, d: on.rename(d + "/e/", d + "/n/"),
    "truncate a file, with a slash": lambda on, d: on.truncate(d + "/a/", 1),
    "read a file, with a slash": lambda on, d: on.read_bytes(d + "/a/"),
    "read a directory, with a slash": lambda on, d: on.read_bytes(d + "/e/"),
    "read nothing, with a slash": lambda on, d: on.read_bytes(d + "/nothing/"),
    "write a file, with a slash": lambda on, d: on.write_bytes(d + "/a/", DATA),
    "write nothing, with a slash": lambda on, d: on.write_bytes(d + "/n/", DATA),
    "mkdir, with a slash": lambda on, d: on.mkdir(d + "/n/"),
    "rmdir, with a slash": lambda on, d: on.rmdir(d + "/e/"),
    "ends of lines": lambda on, d: (on.write_bytes(d + "/n", b"1\r\n2\r3\n"), on.read_text(d + "/n")),
    "text of one kind": lambda on, d: on.write_text(d + "/n", "1\r\n2\n"),
}


def outcome(call: Call, on: object, directory: str) -> object:
    try:
        return call(on, directory)
    except OSError as exc:
        return type(exc), exc.errno


def tree(directory: Path) -> dict[str, bytes | None]:
    return {
        str(path.relative_to(directory)): path.read_bytes() if path.is_file() else None
        for path in sorted(directory.rglob("*"))
    }


@pytest.mark.parametrize("name", CALLS)
def test_calls_do_and_raise_what_the_os_does(
    shared: mavftpfs.Drone, card: Path, tmp_path: Path, name: str
) -> None:
    here = tmp_path / "d"
    for place in (card, here):
        place.mkdir(exist_ok=True)
        (place / "a").write_text("hello")
        (place / "b").write_text("other")
        (place / "e").mkdir()
    real = outcome(CALLS[name], Local(), str(here))
    ours = outcome(CALLS[name], shared, f"/{card.name}")
    assert kind_of(ours) == kind_of(real)
    assert tree(card) == tree(here)


def kind_of(told: object) -> object:
    """Return an outcome without what is told of undelivered files beyond the kind of their error."""
    if isinstance(told, tuple) and isinstance(told[0], type):
        return next(kind for kind in told[0].__mro__ if kind.__module__ == "builtins"), told[1]
    return told


def test_entries(shared: mavftpfs.Drone, card: Path) -> None:
    (card / "Flüge").mkdir()
    (card / "Flüge" / "a b.txt").write_bytes(DATA)
    (found,) = shared.scandir(f"/{card.name}")
    assert (found.name, found.path, found.is_dir(), found.is_file()) == (
        "Flüge",
        f"/{card.name}/Flüge",
        True,
        False,
    )
    (found,) = shared.scandir(os.fsencode(found.path))
    assert (found.name, found.size, found.is_file()) == ("a b.txt", len(DATA), True)
    assert [entry.name for entry in shared.walk(Path(f"/{card.name}"))] == ["Flüge", "a b.txt"]
    assert shared.crc32(found.path) == crc32(DATA)
    shared.remove(f"{card.name}/Flüge", recursive=True)
    assert shared.listdir(card.name) == []


def test_errors_are_sentences(shared: mavftpfs.Drone, card: Path) -> None:
    with pytest.raises(FileNotFoundError, match=f"'/{card.name}/ä' does not exist") as caught:
        shared.stat(f"/{card.name}/ä")
    assert caught.value.errno == errno.ENOENT
    with pytest.raises(OSError, match="may contain neither"):
        shared.stat("/a/../b")


def test_what_was_not_delivered_can_be_pickled() -> None:
    cause = VehicleLost("silent")
    error = errors.NotDelivered("/f", there=False)
    error.__cause__ = cause
    told = pickle.loads(pickle.dumps(os_error(error)))
    assert isinstance(told, mavftpfs.NotDelivered)
    assert isinstance(told, TimeoutError)
    assert (told.on_vehicle, str(told)) == (False, str(os_error(error)))


def test_get_and_put(shared: mavftpfs.Drone, card: Path, tmp_path: Path) -> None:
    local = tmp_path / "d"
    (local / "e").mkdir(parents=True)
    (local / "e" / "f").write_bytes(DATA)
    assert shared.put(local, card.name, recursive=True) == [f"/{card.name}/d/e/f"]
    for _ in range(2):  # what is here already is returned, too
        assert shared.get(f"{card.name}/d/e/f", tmp_path / "x") == [tmp_path / "x"]
    assert (tmp_path / "x").read_bytes() == DATA
    fetched = shared.get(f"{card.name}/d", tmp_path / "y", recursive=True)
    assert [path.read_bytes() for path in fetched] == [DATA]
    with pytest.raises(IsADirectoryError, match="recursive=True"):
        shared.get(f"{card.name}/d", tmp_path / "z")
    with pytest.raises(FileNotFoundError):
        shared.get(f"{card.name}/nothing", tmp_path / "z")
    with pytest.raises(IsADirectoryError, match="recursive=True"):
        shared.put(local, card.name)
    with pytest.raises(FileNotFoundError):
        shared.put(tmp_path / "nothing", card.name)
    with pytest.raises(FileNotFoundError, match="no such directory"):
        shared.put(tmp_path / "x", f"{card.name}/nothing/")
    with pytest.raises(NotADirectoryError):
        shared.get(f"{card.name}/d/e/f/", tmp_path / "z")
    with pytest.raises(IsADirectoryError):
        shared.copy(f"{card.name}/d/e/f", f"{card.name}/nothing/")


@pytest.mark.parametrize(("blocked", "kind"), [("d/x", mavftpfs.UsageError), ("d/x.part", IsADirectoryError)])
def test_get_says_what_did_not_come_and_how_much_did(
    shared: mavftpfs.Drone, card: Path, tmp_path: Path, blocked: str, kind: type[Exception]
) -> None:
    (card / "d").mkdir()
    for name in ("x", "y"):
        (card / "d" / name).write_bytes(DATA)
    (tmp_path / blocked).mkdir(parents=True)
    with pytest.raises(kind) as caught:
        shared.get(f"{card.name}/d", tmp_path, recursive=True)
    assert str(caught.value).endswith("irectory; 1 of 2 files are here")


@pytest.mark.holds("promise 3")
def test_a_file_is_not_copied_onto_itself(shared: mavftpfs.Drone, card: Path) -> None:
    (card / "f").write_bytes(DATA)
    with pytest.raises(OSError, match="onto itself"):
        shared.copy(f"/{card.name}/f", f"{card.name}//f")
    assert (card / "f").read_bytes() == DATA


def test_sync(shared: mavftpfs.Drone, card: Path, tmp_path: Path) -> None:
    (card / "1.ulg").write_bytes(DATA)
    assert shared.sync(tmp_path / "logs", place=card.name) == [tmp_path / "logs" / "1.ulg"]
    assert shared.sync(tmp_path / "logs", place=card.name) == []
    assert (tmp_path / "logs" / "1.ulg").read_bytes() == DATA


def test_sync_takes_the_dates_and_patterns_of_the_command(
    shared: mavftpfs.Drone, card: Path, tmp_path: Path
) -> None:
    for name in ("2020-01-01.ulg", "2026-05-01.ulg", "2026-05-02.ulg", "2026-05-02.txt"):
        (card / name).write_bytes(DATA)
        os.utime(card / name, (1, latest_in(os.fsencode(name)) or 1))
    for number, (choice, names) in enumerate(
        {
            "2h": ({"since": "2h"}, set()),
            "date": ({"since": "2026-05-02", "exclude": "*.txt"}, {"2026-05-02.ulg"}),
            "datetime": ({"since": datetime(2026, 5, 2), "include": ["*.ulg"]}, {"2026-05-02.ulg"}),
            "newest": ({"newest": 1, "include": ("*01.ulg", "*02.ulg")}, {"2026-05-02.ulg"}),
        }.values()
    ):
        found = shared.sync(tmp_path / str(number), place=card.name, **choice)  # type: ignore[arg-type]
        assert {path.name for path in found} == names
    (got,) = shared.get(card.name, tmp_path / "got", recursive=True, include="*.txt")
    assert got.name == "2026-05-02.txt"


@pytest.mark.parametrize(
    "wrong",
    [
        {"since": "soon"},
        {"newest": 0},
        {"verify": "yes"},
    ],
    ids=str,
)
def test_a_wrong_choice_is_refused_before_anything_is_sent(
    shared: mavftpfs.Drone, tmp_path: Path, wrong: dict[str, Any]
) -> None:
    (name,) = wrong
    with pytest.raises(mavftpfs.UsageError, match=f"^{name}"):
        shared.sync(tmp_path / "logs", place="nothing", **wrong)  # sent, this would be FileNotFoundError
    if name == "verify":
        with pytest.raises(mavftpfs.UsageError, match=f"^{name}"):
            shared.get("nothing", tmp_path, **wrong)


def test_threads(shared: mavftpfs.Drone, card: Path) -> None:
    done = []

    def work(number: int) -> None:
        with shared.open(f"/{card.name}/{number}", "w") as file:
            for line in range(50):
                print(number, line, file=file)
        done.append(shared.read_text(f"/{card.name}/{number}").count("\n"))

    threads = [threading.Thread(target=work, args=(number,)) for number in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert done == [50] * 8


@pytest.mark.parametrize("profile", ["px4-2026", "ardupilot"])
def test_parameters(field: Field, profile: str) -> None:
    with mavftpfs.connect(field.sim(field.local("card"), profile).source) as drone:
        before = dict(drone.params)
        assert len(drone.params) == len(before) > 20
        name = next(name for name, value in before.items() if isinstance(value, float) and 1 < value < 5000)
        other = next(name for name, value in before.items() if isinstance(value, int) and 1 < value < 5000)
        drone.params[name] = before[name] + 0.5
        drone.params.update({name: numpy.float64(before[name] + 0.1), other: before[other] + 1})
        assert drone.params[name] == round(before[name] + 0.1, 6)
        assert drone.params[other] == before[other] + 1
        for bad in ({"NO_SUCH": 1}, {name: "much"}, {name: True}):
            with pytest.raises(ValueError, match=r"NO_SUCH|is a number"):
                drone.params.update(bad)  # type: ignore[arg-type]
        with pytest.raises(OSError, match=r"fit|whole"):
            drone.params[other] = 0.5
        with pytest.raises(KeyError):
            drone.params["NO_SUCH"]


def test_a_look_at_all_parameters_is_one_look() -> None:
    """dict() asks a mapping for each value."""
    looks: list[int] = []

    def read() -> dict[str, int | float]:
        looks.append(1)
        return {"A": len(looks), "B": len(looks)}

    params = Params(read, print)
    assert dict(params) == {"A": 1, "B": 1}
    params["A"] = 5
    assert list(params.items()) == [("A", 2), ("B", 2)]


def test_a_vehicle_without_parameters_in_ftp(shared: mavftpfs.Drone) -> None:
    with pytest.raises(FileNotFoundError, match="no parameters in MAVLink FTP"):
        dict(shared.params)


# -- connecting -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("source", "options", "kind", "said"),
    [
        ("udpin:127.0.0.1:0", {"connect_timeout": 1}, TimeoutError, "no vehicle on"),
        ("/dev/ttyNOWHERE", {}, FileNotFoundError, "there is no /dev/ttyNOWHERE"),
        ("tcp:127.0.0.1:9", {"connect_timeout": 1}, ConnectionRefusedError, "nothing listens"),
        ("udpin:127.0.0.1:0", {"frobnicate": 1}, mavftpfs.UsageError, "unknown option 'frobnicate'"),
        ("udpin:127.0.0.1:0", {"chunk": 0}, ValueError, "chunk=0: must be within 16 and 239"),
        ("nonsense", {}, mavftpfs.UsageError, "nonsense"),
    ],
)
def test_why_there_is_no_connection(
    source: str, options: dict[str, Any], kind: type[Exception], said: str
) -> None:
    with pytest.raises(kind, match=said):
        mavftpfs.connect(source, **options)


def test_an_option_that_is_gone_is_a_warning_where_the_program_gives_it() -> None:
    with (
        pytest.warns(DeprecationWarning, match="option window is gone, and is ignored") as told,
        pytest.raises(FileNotFoundError),
    ):
        mavftpfs.connect("/dev/ttyNOWHERE", window=4)
    assert [one.filename for one in told] == [__file__]


def test_a_port_that_is_taken() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        with pytest.raises(OSError, match="in use") as caught:
            mavftpfs.connect(f"udpin:127.0.0.1:{other.getsockname()[1]}")
    assert caught.value.errno == errno.EADDRINUSE


def test_options_are_a_mount_s(vehicle: SimVehicle, field: Field) -> None:
    card = field.local("card")
    (card / "sub" / "e").mkdir(parents=True)
    (card / "sub" / "f").write_bytes(DATA)
    other = field.sim(card, "px4")
    with mavftpfs.connect(other.source + "#/sub", ro=True, tlog=card / "tlog") as drone:
        assert drone.read_bytes("f") == DATA
        assert drone.status()["vehicle"]["autopilot"] == "PX4"
        assert drone.mountpoint is None
        assert not drone.exists("/others")
        (card / "sub" / "others").touch()
        assert not drone.exists("/others")
        drone.refresh()
        assert drone.exists("/others")
        with pytest.raises(OSError, match="because the option ro was given") as caught:
            drone.write_bytes("f", b"")
        assert caught.value.errno == errno.EROFS
    assert (card / "tlog").stat().st_size


def test_closed(field: Field) -> None:
    card = field.local("card")
    (card / "g").touch()
    drone = mavftpfs.connect(field.sim(card).source)
    file, read = drone.open("/f", "w"), drone.open("/g")
    drone.close()
    drone.close()
    read.close()
    for call in (drone.listdir, file.close):
        with pytest.raises(ValueError, match="is closed"):
            call()
    assert list(card.iterdir()) == [card / "g"]


# -- through a mount ------------------------------------------------------------------------------


@pytest.mark.mount
def test_a_mount_that_is_up_is_used(field: Field) -> None:
    card = field.local("card")
    (card / "f").write_bytes(DATA)
    vehicle = field.sim(card)
    mount = field.mount(vehicle.source)
    for source in (vehicle.source, str(mount.path)):
        with mavftpfs.connect(source) as drone:
            assert drone.mountpoint == str(mount.path)
            assert drone.read_bytes("/f") == DATA
            drone.write_text("/d.txt", "one\n")
            with drone.open("/d.txt", "a") as file:
                file.write("two\n")
            assert drone.read_text("/d.txt") == (card / "d.txt").read_text() == "one\ntwo\n"
            drone.truncate("/d.txt", 3)
            assert (card / "d.txt").read_text() == "one"
            with pytest.raises(FileNotFoundError):
                drone.open("/nothing")
            with pytest.raises(FileExistsError):
                drone.mkdir("/f")
            assert drone.put(__file__, "/") == [f"/{Path(__file__).name}"]
            assert drone.crc32("/f") == crc32(DATA)
            assert drone.status()["mountpoint"] == str(mount.path)
    with pytest.raises(mavftpfs.UsageError, match="use_mount=False"):
        mavftpfs.connect(str(mount.path), use_mount=False)
    with pytest.raises(mavftpfs.UsageError, match="name the directory in it"):
        mavftpfs.connect(str(mount.path), root="/d")
    with mavftpfs.connect(vehicle.source, ro=True) as drone:
        for change in (CALLS["bytes"], CALLS["mkdir"], CALLS["truncate"], CALLS["remove"], CALLS["rename"]):
            with pytest.raises(OSError, match="because the option ro was given") as caught:
                change(drone, "")
            assert caught.value.errno == errno.EROFS
        assert drone.read_bytes("/f") == DATA
    with mavftpfs.connect(vehicle.source, use_mount=False) as drone:
        assert drone.mountpoint is None
        assert drone.read_bytes("/f") == DATA


@pytest.mark.mount
@pytest.mark.holds("promise 1")
def test_a_mount_that_takes_a_part_of_a_write_has_not_taken_it(field: Field) -> None:
    card = field.local("card")
    mount = field.mount(field.sim(card).source)
    resource.prlimit(mount.alive().popen.pid, resource.RLIMIT_FSIZE, (1 << 20, 1 << 20))
    with mavftpfs.connect(str(mount.path)) as drone, pytest.raises(OSError, match="discarded") as caught:
        drone.write_bytes("/f", bytes(3 << 20))
    assert caught.value.errno == errno.ENOSPC
    wait_until("the repair removed its temporary file", lambda: list(card.iterdir()) == [])


@pytest.mark.mount
def test_through_a_mount_a_file_that_was_cut_ends_where_it_was_cut(field: Field) -> None:
    card = field.local("card")
    (card / "f").write_bytes(b"0123456789")
    mount = field.mount(field.sim(card).source)
    with mavftpfs.connect(str(mount.path)) as drone, drone.open("/f", "r+b", buffering=0) as file:
        file.truncate(3)
        assert file.seek(0, os.SEEK_END) == 3
        file.write(b"x")
    assert (card / "f").read_bytes() == b"012x"


NAMED = [
    *("list a file", "list nothing", "stat nothing", "mkdir there", "mkdir below nothing", "rmdir full"),
    *("rmdir a file", "remove a directory", "remove nothing", "rename nothing", "rename over a directory"),
    *("rename below nothing", "rename into itself"),
    *("truncate nothing", "read a directory", "open a directory", "write a directory", "write below nothing"),
]


def crc32_of(drone: Any, path: str) -> object:
    return drone.crc32(path)


@pytest.mark.mount
def test_an_error_is_said_in_the_same_words_over_a_mount(field: Field) -> None:
    card = field.local("card")
    (card / "d/e").mkdir(parents=True)
    for name in ("a", "b"):
        (card / "d" / name).touch()
    vehicle = field.sim(card)
    mount = field.mount(vehicle.source, "op_deadline=1")
    calls = {**{name: CALLS[name] for name in NAMED}, "crc32": crc32_of}
    said: list[dict[str, tuple[type, str]]] = []
    for use_mount in (False, True):
        with mavftpfs.connect(vehicle.source, use_mount=use_mount) as drone:
            assert (drone.mountpoint == str(mount.path)) == use_mount
            said.append({name: refusal(call, drone) for name, call in calls.items()})
    assert said[0] == said[1]
    with mavftpfs.connect(str(mount.path)) as drone:
        vehicle.pause()
        with pytest.raises(TimeoutError, match="no answer within 1 s"):
            CALLS["mkdir"](drone, "")
        vehicle.resume()


@pytest.mark.mount
@pytest.mark.holds("promise 9")
def test_a_checksum_in_flight_is_one_error_with_and_without_a_mount(field: Field) -> None:
    card = field.local("card")
    (card / "f").write_bytes(b"data")
    vehicle = field.sim(card, "px4", ("--armed",))
    field.mount(vehicle.source)
    said = []
    for use_mount in (False, True):
        with mavftpfs.connect(vehicle.source, use_mount=use_mount) as drone:
            assert (drone.mountpoint is not None) == use_mount
            with pytest.raises(OSError, match="in flight") as caught:
                drone.crc32("/f")
            said.append((caught.value.errno, str(caught.value)))
    assert said[0] == said[1]
    assert said[0][0] == errno.EROFS


def refusal(call: Call, drone: mavftpfs.Drone) -> tuple[type, str]:
    """Return the error that a call ends with."""
    with pytest.raises(OSError, match="/") as caught:
        call(drone, "/d")
    return type(caught.value), str(caught.value)


@pytest.mark.mount
def test_refresh_reaches_a_mount(field: Field) -> None:
    card = field.local("card")
    (card / "f").write_bytes(DATA)
    vehicle = field.sim(card)
    mount = field.mount(vehicle.source, "dir_timeout=600")
    with mavftpfs.connect(str(mount.path)) as drone:
        assert drone.stat("/f").size == len(DATA)
        assert not drone.exists("/others")
        (card / "others").touch()
        (card / "f").write_bytes(b"short")
        assert not drone.exists("/others")
        drone.refresh()
        assert drone.exists("/others")
        assert drone.stat("/f").size == 5


@pytest.mark.mount
def test_a_permission_is_one_here_and_there(field: Field) -> None:
    """NuttX lets nothing be written outside of its card."""
    vehicle = field.sim(field.local("card"), "px4-nuttx")
    with (
        mavftpfs.connect(vehicle.source) as drone,
        pytest.raises(PermissionError, match="protected") as caught,
    ):
        drone.write_bytes("/f", b"data")
    assert isinstance(caught.value, mavftpfs.NotDelivered)
    assert caught.value.on_vehicle is False
    mount = field.mount(vehicle.source)
    with mavftpfs.connect(str(mount.path)) as drone, pytest.raises(PermissionError) as caught:
        drone.write_bytes("/f", b"data")
    assert isinstance(caught.value, mavftpfs.NotDelivered)
    assert caught.value.on_vehicle is False


def test_a_change_names_its_vehicle_where_several_are_heard(
    field: Field, caplog: pytest.LogCaptureFixture
) -> None:
    link = f"udpout:{HOST}:{free_udp_port()}"
    one, two = (field.sim(field.local(f"card{n}"), options=("--system", str(n)), link=link) for n in (1, 2))
    (two.root / "f").write_bytes(DATA)
    with mavftpfs.connect(one.source) as drone:
        calls: dict[str, Callable[[], object]] = {
            "mkdir": lambda: drone.mkdir("d"),
            "open": lambda: drone.open("f", "w"),
            "write": lambda: drone.write_text("f", "text"),
            "put": lambda: drone.put(__file__, "/"),
            "remove": lambda: drone.remove("f"),
            "param": lambda: drone.params.update({"RTL_ALT": 3}),
        }
        for call in calls.values():
            with pytest.raises(
                mavftpfs.UsageError, match="choose one with target_system=1 or target_system=2"
            ):
                call()
        wait_until("it is said", lambda: "also heard: " in caplog.text)
    with mavftpfs.connect(one.source, target_system=2) as drone:
        drone.remove("f")
        assert drone.listdir() == []
    assert caplog.text.count("also heard: ") == 1
