"""mount.life: what each signal and each failure means in each state, and which exit code it leaves."""

from __future__ import annotations

import signal
from collections.abc import Awaitable, Callable, Iterator, Mapping
from typing import Any

import pytest
import trio

from mavftpfs.link.uri import parse_source
from mavftpfs.mount.life import Life, MountRequest, State
from mavftpfs.shared.errors import ExitCode, LinkClosed
from mavftpfs.shared.options import Options

SOURCE = "udpin:127.0.0.1:14550"

Step = Callable[["Mount"], Awaitable[None]]


class Mount(Life):
    """Goes through the steps given; notes what it was told to do, and what the waiting command was told."""

    def __init__(self, *steps: Step) -> None:
        request = MountRequest(SOURCE, parse_source(SOURCE), "/nowhere", Options())
        super().__init__(request, lambda code, line: self.reported.append((code, line)))
        self.steps = steps
        self.reported: list[tuple[int, str]] = []
        self.told: list[str] = []
        self.gone = trio.Event()

    async def serve(self, nursery: trio.Nursery) -> None:
        for step in self.steps:
            await step(self)

    async def unmount(self, *, lazy: bool) -> None:
        self.told.append("unmount")

    def leave(self) -> None:
        self.told.append("leave")
        self.enter(State.LEAVING)
        self.gone.set()

    def hurry(self) -> None:
        self.told.append("hurry")
        self.stop()

    def status(self) -> Mapping[str, Any]:
        return {}


async def mounted(mount: Mount) -> None:
    mount.enter(State.MOUNTED)
    mount.tell_mounted("")


async def signalled(mount: Mount) -> None:
    signal.raise_signal(signal.SIGTERM)
    with trio.fail_after(60):
        await mount.gone.wait()


async def delivering_and_signalled(mount: Mount) -> None:
    """Deliver for ever, and be told to hurry; then something is left."""
    try:
        signal.raise_signal(signal.SIGTERM)
        with trio.fail_after(60):
            await trio.sleep_forever()
    finally:
        mount.note_end(ExitCode.UNDELIVERED, "1 file did not reach the vehicle")


async def link_fails(mount: Mount) -> None:
    raise LinkClosed("the port is gone")


async def test_a_signal_while_it_starts_ends_it() -> None:
    mount = Mount(signalled)
    assert await mount.run() == ExitCode.INTERRUPTED
    assert mount.reported == [(ExitCode.INTERRUPTED, "interrupted")]
    assert mount.told == []


@pytest.mark.holds("promise 3")
async def test_the_first_signal_delivers_and_the_next_one_keeps() -> None:
    mount = Mount(mounted, signalled, delivering_and_signalled)
    assert await mount.run() == ExitCode.UNDELIVERED
    assert mount.reported == [(0, "")]
    assert mount.told == ["leave", "hurry"]
    assert mount.state is State.ENDED


async def test_a_failure_is_told_to_the_waiting_command_or_else_to_the_log(
    caplog: pytest.LogCaptureFixture,
) -> None:
    starting = Mount(link_fails)
    assert await starting.run() == ExitCode.NO_VEHICLE
    assert starting.reported == [(ExitCode.NO_VEHICLE, "the port is gone")]
    assert caplog.records == []
    up = Mount(mounted, link_fails)
    assert await up.run() == ExitCode.NO_VEHICLE
    assert up.reported == [(0, "")]
    assert [record.getMessage() for record in caplog.records] == ["unmounted: the port is gone"]


async def test_what_a_user_should_know_is_in_the_log_too(caplog: pytest.LogCaptureFixture) -> None:
    """In the foreground the log is all that is read."""

    async def noticed(mount: Mount) -> None:
        mount.enter(State.MOUNTED)
        mount.tell_mounted("2/1 is heard, too")

    mount = Mount(noticed)
    await mount.run()
    assert mount.reported == [(0, "2/1 is heard, too")]
    assert [record.getMessage() for record in caplog.records] == ["2/1 is heard, too"]


@pytest.mark.holds("promise 3")
async def test_an_error_hides_not_that_bytes_were_left() -> None:
    async def left(mount: Mount) -> None:
        mount.note_end(ExitCode.UNDELIVERED, "1 file did not reach the vehicle")

    assert await Mount(mounted, left, link_fails).run() == ExitCode.UNDELIVERED


@pytest.fixture
def ignoring_hangup() -> Iterator[None]:
    """As nohup starts a program."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.mark.usefixtures("ignoring_hangup")
async def test_nohup_is_respected() -> None:
    async def hung_up(mount: Mount) -> None:
        signal.raise_signal(signal.SIGHUP)
        await trio.sleep(0.05)
        assert mount.told == []

    assert await Mount(mounted, hung_up, signalled).run() == 0
