"""Hazards for a library: programs interrupt it, fork, forget to close, collect garbage anywhere."""

from __future__ import annotations

import gc
import os
import signal
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

import mavftpfs
from mavftpfs.client.files import usable_status
from mavftpfs.shared.errors import LinkClosed
from tests.mount.conftest import Field
from tests.support.mounts import wait_until
from tests.support.trees import content
from tests.support.vehicles import SimVehicle

OLD, NEW = b"old", content("new", 30_000)
PATIENCE = 60.0
QUICK: dict[str, Any] = {"op_deadline": 1, "connect_timeout": 30}


@pytest.fixture
def sim(field: Field) -> SimVehicle:
    """A PX4 whose card has one file."""
    card = field.local("card")
    (card / "f").write_bytes(OLD)
    return field.sim(card, "px4")


@contextmanager
def silent(vehicle: SimVehicle) -> Iterator[None]:
    """Have the vehicle say nothing during the body."""
    vehicle.pause()
    try:
        yield
    finally:
        vehicle.resume()


def on_card(vehicle: SimVehicle) -> dict[str, bytes]:
    """Return what is on the card, without our own names: a vehicle that was paused finds requests waiting."""
    return {
        path.name: path.read_bytes()
        for path in vehicle.root.iterdir()
        if not path.name.startswith(".mavftpfs")
    }


def settle(drone: mavftpfs.Drone) -> None:
    """Wait until the vehicle answers again, and everything that might be sent was."""

    def answers() -> bool:
        try:
            drone.refresh()
            return bool(drone.listdir())
        except OSError:
            return False

    wait_until("the vehicle answers", answers)
    time.sleep(3)  # longer than the caches wait before they try again by themselves


# -- what became of a written file ----------------------------------------------------------------


@pytest.mark.holds("promise 2")
@pytest.mark.parametrize("through", ["connection", pytest.param("mount", marks=pytest.mark.mount)])
def test_what_was_not_delivered_is_said_and_never_comes(
    sim: SimVehicle, field: Field, tmp_path: Path, through: str
) -> None:
    source = sim.source
    if through == "mount":
        source = str(field.mount(sim.source, "op_deadline=2").path)
    (tmp_path / "local").write_bytes(NEW)
    with mavftpfs.connect(source, **QUICK) as drone:
        files = [drone.open("/f", "wb"), drone.open("/fresh", "xb"), drone.open("/appended", "ab")]
        for file in files:
            file.write(NEW)
        with silent(sim):
            for end in (lambda: drone.put(tmp_path / "local", "/put"), *(file.close for file in files)):
                with pytest.raises(mavftpfs.NotDelivered, match="discarded") as caught:
                    end()
                assert isinstance(caught.value, TimeoutError)
                assert caught.value.on_vehicle is False
            assert all(file.closed for file in files)
        settle(drone)
        assert on_card(sim) == {"f": OLD}
        assert drone.read_bytes("/f") == OLD
        drone.write_bytes("/f", NEW)
    assert on_card(sim) == {"f": NEW}


def test_a_part_does_not_pass_for_the_whole(sim: SimVehicle) -> None:
    """A write that failed is not forgotten at the close."""
    with mavftpfs.connect(sim.source, **QUICK) as drone:
        file = drone.open("/f", "wb", buffering=0)

        def write_all() -> None:
            for _ in range(100):
                file.write(NEW)

        with silent(sim), pytest.raises(TimeoutError):
            write_all()
        settle(drone)
        with pytest.raises(mavftpfs.NotDelivered) as caught:
            file.close()
        assert caught.value.on_vehicle is False
        assert drone.read_bytes("/f") == OLD


READER = """
import os, sys
files = []
for line in sys.stdin:
    if line == "open\\n":
        files.append(os.open(sys.argv[1], os.O_RDONLY))
    print(*(len(os.pread(fd, 50_000, 0)) for fd in files), flush=True)
"""


@pytest.mark.mount
def test_a_reader_of_the_mount_sees_all_that_was_withdrawn_or_nothing_of_it(
    sim: SimVehicle, field: Field
) -> None:
    path = field.mount(sim.source).path / "f"
    argv = [sys.executable, "-c", READER, str(path)]
    with (
        subprocess.Popen(argv, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as reader,
        mavftpfs.connect(str(path.parent)) as drone,
    ):

        def asked(line: str) -> str:
            assert reader.stdin is not None
            assert reader.stdout is not None
            print(line, file=reader.stdin, flush=True)
            return reader.stdout.readline().strip()

        file = drone.open("/f", "wb", buffering=0)
        file.write(NEW)
        assert asked("open") == f"{len(NEW)}"
        with pytest.warns(ResourceWarning, match="discarded"):
            del file
        wait_until("its changes are discarded", lambda: drone.stat("/f").size == len(OLD))
        assert asked("") == f"{len(NEW)}"
        assert asked("open") == f"{len(NEW)} {len(OLD)}"
    assert on_card(sim) == {"f": OLD}


@pytest.mark.mount
def test_what_a_program_wrote_is_withdrawn_at_its_end_though_it_forked(sim: SimVehicle, field: Field) -> None:
    mount = field.mount(sim.source)
    code = f"""
drone = mavftpfs.connect({str(mount.path)!r})
f = drone.open("/f", "wb", buffering=0)
f.write(b"half")
os.spawnlp(os.P_WAIT, "true", "true")
"""
    assert "its changes are discarded" in program(sim, code).stderr
    assert on_card(sim) == {"f": OLD}


@pytest.mark.mount
def test_after_a_part_was_delivered_nobody_claims_that_the_old_file_is_there(
    sim: SimVehicle, field: Field
) -> None:
    mount = field.mount(sim.source, "op_deadline=2")
    with mavftpfs.connect(str(mount.path)) as drone:
        file = drone.open("/f", "wb", buffering=0)
        file.write(b"half")
        mount.run("sync", mount.path / "f")
        assert on_card(sim) == {"f": b"half"}
        file.write(NEW)
        with silent(sim), pytest.raises(mavftpfs.NotDelivered, match="look before you use it") as caught:
            file.close()
        assert caught.value.on_vehicle is None
        settle(drone)
        assert on_card(sim) == {"f": b"half"}


# -- Ctrl-C ---------------------------------------------------------------------------------------


@contextmanager
def ctrl_c() -> Iterator[None]:
    """Interrupt the body soon."""
    timer = threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    try:
        yield
    finally:
        timer.join()


def test_ctrl_c_ends_a_call_and_nothing_else(sim: SimVehicle) -> None:
    with mavftpfs.connect(sim.source) as drone:
        with silent(sim), pytest.raises(KeyboardInterrupt), ctrl_c():
            drone.read_bytes("/f")
        settle(drone)
        assert drone.read_bytes("/f") == OLD


def test_ctrl_c_while_a_file_is_written_withdraws_it(sim: SimVehicle) -> None:
    with mavftpfs.connect(sim.source, target_system=1, op_deadline=5) as drone:

        def write_half() -> None:
            with drone.open("/f", "w") as file:
                file.write("half")
                file.flush()
                drone.stat("/nothing")

        with silent(sim), pytest.raises(KeyboardInterrupt) as caught, ctrl_c():
            write_half()
        assert "discarded" in caught.value.__notes__[0]
        settle(drone)
        assert drone.read_bytes("/f") == OLD


def test_ctrl_c_while_connecting() -> None:
    before = threading.active_count()
    with pytest.raises(KeyboardInterrupt), ctrl_c():
        mavftpfs.connect("udpin:127.0.0.1:0")
    wait_until("the thread ended", lambda: threading.active_count() == before)


def test_ctrl_c_just_after_a_write_does_not_append_twice(
    sim: SimVehicle, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Python's buffer keeps the bytes of a write that was interrupted, and writes them again at the close."""
    with mavftpfs.connect(sim.source) as drone:
        file = drone.open("/f", "ab")
        file.write(NEW)
        wait = drone._loop._wait

        def wait_and_interrupt(call: Any) -> None:
            wait(call)
            raise KeyboardInterrupt

        monkeypatch.setattr(drone._loop, "_wait", wait_and_interrupt)
        with pytest.raises(KeyboardInterrupt):
            file.flush()
        monkeypatch.undo()
        with pytest.raises(mavftpfs.NotDelivered, match="discarded"):
            file.close()
    assert on_card(sim) == {"f": OLD}


# -- garbage --------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", ["w", "wb", "r+", "a", "r", "rb"])
def test_an_open_file_may_be_collected_in_the_connection_s_own_thread(sim: SimVehicle, mode: str) -> None:
    with mavftpfs.connect(sim.source) as drone:

        async def collect() -> None:
            gc.collect()

        files: list[Any] = [drone.open("/f", mode)]
        if "r" not in mode or "+" in mode:
            files[0].write(b"lost" if "b" in mode else "lost")
        files.append(files)  # only the collector finds it
        gc.disable()
        try:
            with warnings.catch_warnings(record=True) as told:
                warnings.simplefilter("always")
                del files
                drone._loop.call(collect)
        finally:
            gc.enable()
        assert [str(one.message).partition(":")[0] for one in told if one.category is ResourceWarning] == [
            "/f was not closed"
        ]
        wait_until("its changes are discarded", lambda: drone.read_bytes("/f") == OLD)
    assert on_card(sim) == {"f": OLD}


def test_a_drone_may_be_collected(sim: SimVehicle) -> None:
    before = threading.active_count()
    drone = mavftpfs.connect(sim.source)
    holder = [drone]
    del drone
    with pytest.warns(ResourceWarning, match="was not closed"):
        holder.clear()
    wait_until("its thread ended", lambda: threading.active_count() == before)


def test_a_file_keeps_its_connection(sim: SimVehicle) -> None:
    sim.left_alone = True  # a finalizer does not wait for the end of the session
    file = mavftpfs.connect(sim.source).open("/f", "rb")
    gc.collect()
    assert file.read() == OLD
    file.close()
    holder = [file]
    del file
    with pytest.warns(ResourceWarning, match="was not closed"):
        holder.clear()


def program(sim: SimVehicle, code: str) -> subprocess.CompletedProcess[str]:
    """Run a program of its own with the vehicle as `drone`."""
    head = f"import mavftpfs, os, sys, warnings\ndrone = mavftpfs.connect({sim.source!r})\n"
    return subprocess.run(
        [sys.executable, "-c", head + code], capture_output=True, text=True, timeout=PATIENCE, check=False
    )


@pytest.mark.parametrize("end", ["", "sys.exit(3)", "raise SystemError('bug')"])
def test_a_program_that_closes_nothing_ends_and_says_what_is_lost(sim: SimVehicle, end: str) -> None:
    done = program(sim, f"f = drone.open('/f', 'w'); f.write('half'); g = drone.open('/f')\n{end}")
    assert done.stderr.count("/f was not closed: its changes are discarded") == 1
    assert done.returncode == (3 if "3" in end else 1 if "bug" in end else 0)
    assert on_card(sim) == {"f": OLD}


def test_a_program_that_ends_while_the_vehicle_is_silent(sim: SimVehicle) -> None:
    assert sim.process is not None
    code = f"f = drone.open('/f', 'w'); f.write('half'); f.flush(); os.kill({sim.process.popen.pid}, 19)"
    try:
        assert program(sim, code).returncode == 0
    finally:
        sim.resume()
    sim.left_alone = True


# -- processes ------------------------------------------------------------------------------------


def test_a_fork_is_told_that_the_connection_is_not_its_own(sim: SimVehicle) -> None:
    code = """
file = drone.open("/g", "w")
file.write("mine")
warnings.simplefilter("ignore")  # Python 3.12 and later warn of a fork in a program with threads
child = os.fork()
if child == 0:
    for call in (drone.listdir, file.flush, file.close):
        try:
            call()
        except RuntimeError as exc:
            print(exc)
    sys.exit(0)
assert os.waitpid(child, 0)[1] == 0
file.close()
drone.close()
"""
    done = program(sim, code)
    assert (done.returncode, done.stderr) == (0, "")
    assert [line.partition(" and ")[0] for line in done.stdout.splitlines()] == 3 * [
        f"the connection to {sim.source} was made before a fork"
    ]
    assert on_card(sim) == {"f": OLD, "g": b"mine"}


def test_a_pause_before_the_first_call_is_nothing(sim: SimVehicle) -> None:
    with mavftpfs.connect(sim.source, connect_timeout=4) as drone:
        time.sleep(4.5)
        assert drone.read_bytes("/f") == OLD


def test_importing_it_loads_little(tmp_path: Path) -> None:
    def loaded(code: str) -> set[str]:
        show = f"import sys\n{code}\nprint(*sys.modules)"
        return set(subprocess.check_output([sys.executable, "-c", show], text=True, cwd=tmp_path).split())

    assert not {"trio", "pymavlink", "logging"} & loaded("import mavftpfs")
    everything = loaded("import mavftpfs; mavftpfs.connect")
    assert "mavftpfs.api.drone" in everything
    assert not {"pyfuse3", "rich", "argparse", "mavftpfs.cli", "mavftpfs.mount"} & everything
    assert not {"pyfuse3", "rich"} & loaded("import mavftpfs.cli.param")


# -- interrupted, and beside others ---------------------------------------------------------------


def test_an_error_of_the_program_is_not_replaced_by_that_of_its_file(sim: SimVehicle) -> None:
    def write_half(drone: mavftpfs.Drone) -> None:
        with drone.open("/f", "w") as file:
            file.write("half")
            raise KeyError("of the program")

    with mavftpfs.connect(sim.source, **QUICK) as drone, silent(sim), pytest.raises(KeyError) as caught:
        write_half(drone)
    assert "discarded" in caught.value.__notes__[0]


@pytest.mark.mount
def test_many_files_at_once_through_a_mount(sim: SimVehicle, field: Field) -> None:
    mount = field.mount(sim.source)
    with mavftpfs.connect(str(mount.path)) as drone, ThreadPoolExecutor(50) as threads:
        files = [drone.open("/f", "rb", buffering=0) for _ in range(50)]
        assert list(threads.map(lambda file: file.read(), files, timeout=PATIENCE)) == 50 * [OLD]
        for file in files:
            file.close()


@pytest.mark.mount
async def test_a_mount_that_hangs_holds_one_thread_however_often_it_is_asked(
    sim: SimVehicle, field: Field, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mavftpfs.client.files.STATUS_PATIENCE", 0.2)
    mount = field.mount(sim.source)
    assert mount.process is not None
    place = str(mount.path)
    assert (await usable_status(place))["vehicle"]["system"] == 1
    before = threading.active_count()
    mount.process.popen.send_signal(signal.SIGSTOP)
    try:
        for _ in range(5):
            with pytest.raises(LinkClosed, match="does not answer"):
                await usable_status(place)
        assert threading.active_count() <= before + 1
    finally:
        mount.process.popen.send_signal(signal.SIGCONT)
    assert (await usable_status(place))["vehicle"]["system"] == 1


@pytest.mark.mount
@pytest.mark.holds("promise 2")
def test_through_a_mount_an_interrupted_open_empties_nothing(sim: SimVehicle, field: Field) -> None:
    mount = field.mount(sim.source, "op_deadline=5", "dir_timeout=0")
    with mavftpfs.connect(str(mount.path)) as drone:
        for path, mode in (("/f", "wb"), ("/f", "rb"), ("/fresh", "xb")):
            with silent(sim), pytest.raises(KeyboardInterrupt), ctrl_c():
                drone.open(path, mode)
            time.sleep(2)
    assert on_card(sim) == {"f": OLD}
