"""The columns of the matrix: what happens at one request of an operation."""

from __future__ import annotations

import errno
import os
from functools import partial
from itertools import count as counted
from random import Random
from unittest.mock import patch

import trio

from mavftpfs.protocol.payload import NakCode, Opcode
from tests.support.latecomers import come_again
from tests.support.matrix.operations import mkdir, rmdir, unlink
from tests.support.matrix.others import OTHERS
from tests.support.matrix.scene import Event, Scene

LATE = 3.0
"""Seconds after which a copy of a request arrives."""

LATE_AT_LEAST, LATE_AT_MOST = 0.3, 6.0


# --- messages that are lost, doubled or refused


def lose_answer(scene: Scene, count: int) -> None:
    """Lose the answer to a request."""
    scene.here.faults.after(
        count, lambda: scene.here.faults.lose_reply_to(Opcode(scene.here.faults.requests[-1]))
    )


def lose_for_good(scene: Scene, count: int) -> None:
    """Lose the answer, and have something else asked, after which no server says the same once more."""

    def action() -> None:
        scene.here.faults.lose_reply_to(Opcode(scene.here.faults.requests[-1]))
        scene.list_at_once()

    scene.here.faults.after(count, action)


def arrive_twice(scene: Scene, count: int) -> None:
    """Have a request arrive twice."""
    scene.here.faults.repeat(count)


def answer_the_second(scene: Scene, count: int) -> None:
    """Have a request arrive twice, and lose the first answer: the other may be a refusal.

    Of a link that was not seen to do so before that is expected for a rename only."""
    if scene.operation in (unlink, mkdir, rmdir):
        scene.here.connection.scheduler.server.distrust(reads=True)
    scene.here.faults.repeat(count)
    lose_answer(scene, count)


def late_copy(scene: Scene, count: int) -> None:
    """Have a request carried out once more, seconds after its answer."""
    numbers = counted(1)
    come_again(scene.here, LATE, lambda _: next(numbers) == count)


def late_copies(scene: Scene, count: int) -> None:
    """Have all requests carried out twice, from before the operation to its end: the mount has seen that, and
    knows by how much."""
    ended, lateness = trio.Event(), Random(count).uniform(LATE_AT_LEAST, LATE_AT_MOST)
    scene.at_end.append(ended.set)
    come_again(scene.here, lateness, lambda _: not ended.is_set())


def full_card(scene: Scene, count: int) -> None:
    """Have the card refuse all bytes from a request on, until the operation ends."""
    faults = scene.here.faults
    full = partial(faults.refuse, Opcode.WRITE_FILE, NakCode.FAIL_ERRNO, errno.ENOSPC, times=100_000)
    faults.after(count, full)


# --- what happens to the link, the vehicle and us


def cut(scene: Scene, count: int) -> None:
    """Cut the link for 4 s."""

    def action() -> None:
        scene.here.link.cut()
        scene.later(4.0, scene.here.link.restore)

    scene.here.faults.after(count, action)


def silence(scene: Scene, count: int) -> None:
    """Lose everything for 40 s: no request can be repeated in time."""

    def action() -> None:
        scene.here.faults.cut_after(0)
        scene.later(40.0, lambda: scene.here.faults.cut_after(None))

    scene.here.faults.after(count, action)


def reboot(scene: Scene, count: int) -> None:
    """Restart the vehicle."""
    scene.here.faults.after(count, lambda: scene.here.vehicle.reboot(trio.current_time(), 2.0))


def arm(scene: Scene, count: int) -> None:
    """Take off, and land 20 s later."""

    def action() -> None:
        scene.here.vehicle.arm()
        scene.later(5.0, scene.whole)
        scene.later(20.0, scene.here.vehicle.disarm)

    scene.here.faults.after(count, action)


def fly_away(scene: Scene, count: int) -> None:
    """Cut the link, and take off before it is back: what lost its name gets it in flight."""

    def action() -> None:
        scene.here.link.cut()
        scene.later(30.0, scene.here.vehicle.arm)
        scene.later(40.0, scene.here.link.restore)
        scene.later(50.0, scene.whole)
        scene.later(55.0, scene.here.vehicle.disarm)

    scene.here.faults.after(count, action)


def rival(scene: Scene, count: int) -> None:
    """Have another ground station reset the sessions, as QGroundControl does."""

    reset = partial(scene.here.another_asks, Opcode.RESET_SESSIONS)
    scene.here.faults.after(count, lambda: scene.later(0.0, reset))


def give_up(scene: Scene, count: int) -> None:
    """Cancel the call, as a handler's deadline does."""
    scene.here.faults.after(count, scene.caller.cancel)


def give_up_in_silence(scene: Scene, count: int) -> None:
    """Cancel the call 5 s after the last answer: no error is left that would tell."""

    def action() -> None:
        scene.here.faults.cut_after(0)
        scene.later(5.0, scene.caller.cancel)
        scene.later(40.0, lambda: scene.here.faults.cut_after(None))

    scene.here.faults.after(count, action)


def power_off(scene: Scene, count: int) -> None:
    """Take the power from the vehicle and from us."""
    scene.here.faults.after(count, scene.here.link.cut)


def full_disk(scene: Scene, count: int) -> None:
    """Have the local disk take nothing more, until the operation ends."""
    _break_disk(scene, count, errno.ENOSPC, "pwrite")


def failing_disk(scene: Scene, count: int) -> None:
    """Have the local disk neither take nor give bytes, until the operation ends."""
    _break_disk(scene, count, errno.EIO, "pwrite", "pread")


def _break_disk(scene: Scene, count: int, number: int, *calls: str) -> None:
    def fail(*_: object) -> bytes:
        raise OSError(number, os.strerror(number))

    patches = [patch.object(os, call, fail) for call in calls]

    def begin() -> None:
        for one in patches:
            one.start()
        scene.at_end.extend(one.stop for one in patches)

    scene.here.faults.after(count, begin)


def nothing(scene: Scene, count: int) -> None:
    """Let it be."""


EVENTS: tuple[Event, ...] = (
    lose_answer, lose_for_good, arrive_twice, answer_the_second, cut, silence, reboot, arm, fly_away, rival,
    give_up, give_up_in_silence, power_off,
)  # fmt: skip
"""Each meets each operation on each server, every day."""

IN_TURN: tuple[Event, ...] = (late_copy, late_copies, full_card, full_disk, failing_disk, *OTHERS)
"""Each meets each operation every day, on one server; in the soak on each."""

OVER: dict[Event, float] = {arm: 25.0, silence: 45.0, give_up_in_silence: 45.0, fly_away: 60.0}
"""Seconds after which an event that lasts is over, from its beginning."""

UNHEARD: dict[Event, float] = {cut: 4.0, reboot: 2.0, **OVER}
"""Seconds for which the vehicle is not heard, or not to be changed."""

UNNOTICED = (nothing, lose_answer, lose_for_good, arrive_twice, answer_the_second, late_copy)
"""Whatever is lost or doubled once, the call succeeds."""

EARLY = (late_copies,)
"""Events that begin before the operation."""

LOCAL = (full_disk, failing_disk)

TWICE = (late_copy, late_copies)
"""Late copies of requests leave files open that nobody knows of."""
