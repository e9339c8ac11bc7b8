"""fsspec: its own tests of file systems, and what people use it for."""

from __future__ import annotations

import pickle
import threading
import time
from collections.abc import Callable, Iterator

import fsspec
import pytest
from fsspec.tests import abstract

import mavftpfs
from mavftpfs.api import fs as fs_module
from mavftpfs.api.fs import DroneFileSystem
from tests.mount.conftest import Field
from tests.support.mounts import wait_until
from tests.support.takingturns import taking_turns
from tests.support.trees import content

ROOTS = {"px4": "/", "ardupilot5": "/APM", "mavsdk": "/"}
DATA = content("f", 200_000)


pytestmark = pytest.mark.filterwarnings(
    "ignore::pytest.PytestRemovedIn10Warning"
)  # of the suite's own fixtures


@pytest.fixture(scope="module", params=taking_turns(ROOTS, soak=("mavsdk",)))
def place(request: pytest.FixtureRequest, module_field: Field) -> Iterator[tuple[DroneFileSystem, str]]:
    """A vehicle (in the soak one of each kind of server), and the directory there that may be written."""
    card = module_field.local("card")
    root = ROOTS[request.param].rstrip("/")
    (card / root.strip("/") / "tests").mkdir(parents=True)
    fs = DroneFileSystem(module_field.sim(card, request.param).source, auto_mkdir=True)
    yield fs, f"{root}/tests"
    fs.close()


@pytest.fixture(scope="module")
def globbed(place: tuple[DroneFileSystem, str]) -> str:
    """The files for patterns, made once: the tests only read them."""
    fs, path = place
    made: str = Fixtures()._glob_edge_cases_files(fs, lambda *parts: "/".join(parts), f"{path}/globbed")
    return made


class Fixtures(abstract.AbstractFixtures):  # type: ignore[misc]
    """The fixtures that the suite asks for."""

    @pytest.fixture
    def fs(self, place: tuple[DroneFileSystem, str]) -> DroneFileSystem:
        return place[0]

    @pytest.fixture
    def fs_path(self, place: tuple[DroneFileSystem, str]) -> str:
        return place[1]

    @pytest.fixture
    def fs_glob_edge_cases_files(self, globbed: str) -> str:
        return globbed

    @pytest.fixture
    def fs_join(self) -> Callable[..., str]:
        return lambda *parts: "/".join(parts)


class TestCopy(abstract.AbstractCopyTests, Fixtures):  # type: ignore[misc]
    pass


class TestGet(abstract.AbstractGetTests, Fixtures):  # type: ignore[misc]
    pass


class TestPut(abstract.AbstractPutTests, Fixtures):  # type: ignore[misc]
    pass


class TestOpen(abstract.AbstractOpenTests, Fixtures):  # type: ignore[misc]
    pass


class TestPipe(abstract.AbstractPipeTests, Fixtures):  # type: ignore[misc]
    pass


# -- what people do with it -----------------------------------------------------------------------


@pytest.fixture(scope="module")
def source(module_field: Field) -> Iterator[str]:
    """A PX4 with a CSV, and a directory with a file."""
    card = module_field.local("card")
    (card / "d" / "e").mkdir(parents=True)
    (card / "data.csv").write_text("time,alt\n" + "".join(f"{n},{n / 2}\n" for n in range(5000)))
    (card / "d" / "f").write_bytes(DATA)
    yield module_field.sim(card, "px4").source
    for connection in fs_module._connections.values():
        connection.close()


@pytest.fixture
def fs(source: str) -> Iterator[DroneFileSystem]:
    made = DroneFileSystem(source)
    yield made
    made.close()


def test_pandas_reads_and_writes_a_csv(source: str, fs: DroneFileSystem) -> None:
    import pandas  # here, since each of the test processes loads this module

    frame = pandas.read_csv("mftp:///data.csv", storage_options={"source": source})
    assert (len(frame), frame.alt.sum()) == (5000, sum(range(5000)) / 2)
    frame.to_csv("mftp:///copy.csv", index=False, storage_options={"source": source})
    assert fs.cat_file("/copy.csv") == fs.cat_file("/data.csv")


def test_urls(source: str) -> None:
    with fsspec.open("mftp://d/f", "rb", source=source) as file:
        assert (file.size, file.read()) == (len(DATA), DATA)
    with fsspec.open("mftp://[comp=1:]d/f", "rb", source=source) as file:
        assert file.read(10) == DATA[:10]
    fs, path = fsspec.core.url_to_fs("mftp://comp=1:/d/a%20b", source=source)
    assert (fs.storage_options["target_component"], path) == (1, "/d/a b")
    assert fsspec.filesystem("mftp", source=source) is fsspec.filesystem("mftp", source=source)
    with pytest.raises(ValueError, match="which vehicle"):
        fsspec.open("mftp://d/f").open()
    with pytest.raises(ValueError, match="component"):
        fsspec.open("mftp://comp=999:/d", source=source)


def test_calls_of_its_own(fs: DroneFileSystem) -> None:
    assert sorted(fs.ls("/d", detail=False)) == ["/d/e", "/d/f"]
    assert fs.info("mftp://d/f")["size"] == fs.size("d/f") == len(DATA)
    assert fs.ls("/d/f")[0]["type"] == "file"
    assert fs.cat_file("/d/f", 100, 200) == DATA[100:200]
    fs.mkdir("/n/m")
    fs.cp_file("/d/f", "/n/f")
    fs.mv("/n/f", "/n/m")
    fs.mv("/n/m/f", "/n/g")
    assert fs.find("/n", withdirs=True) == ["/n", "/n/g", "/n/m"]
    assert fs.checksum("/n/g") == fs.checksum("/d/f")
    with fs.open("/n/text", "w") as file:
        file.write("größe")
    with fs.open("/n/text") as file:
        assert file.read() == "größe".encode()
    with pytest.raises(OSError, match=r"not empty|is a directory"):
        fs.rmdir("/n")
    fs.rm("/n", recursive=True)
    assert not fs.exists("/n")
    with pytest.raises(FileNotFoundError):
        fs.cat_file("/n/text")
    with pytest.raises(OSError, match="does not report"):
        fs.modified("/d/f")
    assert pickle.loads(pickle.dumps(fs)).isfile("/d/f")


@pytest.mark.parametrize("mode", ["w", "wb"])
def test_a_transaction_is_an_error_and_reading_in_one_is_none(fs: DroneFileSystem, mode: str) -> None:
    with fs.transaction, fs.open("/d/f", "rb") as file:
        assert file.read() == DATA
    with fs.transaction, pytest.raises(NotImplementedError, match="no transactions"):
        fs.open("/d/late", mode)
    assert not fs.exists("/d/late")


def test_a_directory_that_cannot_be_listed_is_not_an_empty_one(
    fs: DroneFileSystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    listed = mavftpfs.Drone.scandir

    def refuse(drone: mavftpfs.Drone, path: str) -> Iterator[mavftpfs.Entry]:
        if path == "/d/e":
            raise PermissionError(13, "no")
        return listed(drone, path)

    monkeypatch.setattr(mavftpfs.Drone, "scandir", refuse)
    with pytest.raises(PermissionError):
        fs.find("/d")
    assert fs.find("/nothing") == []


def test_calls_of_many_threads_leave_no_threads(source: str) -> None:
    others = timers()
    fs = DroneFileSystem(source, idle=600)

    def work() -> None:
        for _ in range(10):
            fs.exists("/nothing")

    threads = [threading.Thread(target=work) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    wait_until("one timer is left", lambda: len(timers() - others) <= 1)
    fs.close()
    wait_until("none is left", lambda: not timers() - others)


def timers() -> set[threading.Thread]:
    return {thread for thread in threading.enumerate() if isinstance(thread, threading.Timer)}


def test_a_connection_that_is_idle_is_closed_and_made_again(source: str) -> None:
    fs = DroneFileSystem(source, idle=0.5)
    file = fs.open("/d/f", "rb")
    assert file.read(5) == DATA[:5]
    time.sleep(1.5)
    assert fs._connection.open, "a file of it is open"
    assert file.read() == DATA[5:]
    file.close()
    wait_until("it is closed", lambda: not fs._connection.open)
    assert fs.isdir("/d")
    fs.close()
