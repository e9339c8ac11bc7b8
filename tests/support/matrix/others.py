"""Columns of the matrix: others change the directory, over the vehicle or through the same mount."""

from __future__ import annotations

import errno
from collections.abc import Awaitable, Callable
from contextlib import suppress
from functools import partial

import trio

from mavftpfs.link.messages import Address
from mavftpfs.protocol.payload import NakCode, Opcode, Payload
from mavftpfs.shared.errors import MavftpfsError
from mavftpfs.sim.profiles import PROFILES, Family, Storage
from tests.support.faults import STATION
from tests.support.matrix.operations import FILE, NAME, D, keeping, making, read, rewriting, taking
from tests.support.matrix.scene import Gone, Others, Scene
from tests.support.replies import decode_reply, request
from tests.support.rigs import Rig
from tests.support.transfers import content

THEIRS, MORE, BESIDE = content(800, 5), content(150, 6), content(3000, 7)
TAKES = 300.0
"""Seconds for which the other computer uploads."""

PIECE = 75
"""Bytes it writes every 7.5 s. A client that pauses for 10 s with a file open loses it to the mount
(`session.others.LEFT_OPEN`)."""

PATIENCE = 60


class Interrupted(MavftpfsError):
    """The program ended before its call did."""


class OtherClient:
    """Another FTP client of the vehicle, which repeats what is refused.

    heard: our link carries what it asks, and its answers.
    """

    def __init__(self, here: Rig, heard: bool) -> None:
        self._here = here
        self._heard = heard
        self._seq = 20_000
        self._replies: dict[int, Payload] = {}
        self._came = trio.Event()
        self._session = 77 if PROFILES[here.profile].family is Family.ARDUPILOT else 0
        self._outgoing = here.server.outgoing
        here.server.outgoing = self._on_outgoing  # type: ignore[method-assign]

    def _on_outgoing(self, now: float) -> list[tuple[Address, bytes]]:
        replies = self._outgoing(now)
        for target, wire in replies:
            if target == STATION:
                reply = decode_reply(wire)
                self._replies[reply.seq] = reply
                self._came.set()
        return [reply for reply in replies if self._heard or reply[0] != STATION]

    async def ask(self, opcode: Opcode, data: bytes = b"", *, offset: int = 0) -> bool:
        """Ask once; return whether it was done."""
        self._seq += 10  # so far apart that no server takes one for the one before
        asked = request(self._seq, opcode, session=self._session, offset=offset, data=data)
        now = trio.current_time()
        self._here.vehicle.foreign_request(asked.encode(), STATION, now, audible=self._heard)
        with trio.move_on_after(5.0):
            while self._seq + 1 not in self._replies:
                self._came = trio.Event()
                await self._came.wait()
            reply = self._replies[self._seq + 1]
            if opcode in (Opcode.CREATE_FILE, Opcode.OPEN_FILE_WO) and reply.opcode == Opcode.ACK:
                self._session = reply.session
            return reply.opcode == Opcode.ACK
        return False

    async def write(self, path: bytes, opcode: Opcode, offset: int, data: bytes) -> bool:
        """Open or make a file, write a piece and close it; return whether all of that was done."""
        if not await self.ask(opcode, path):
            return False
        done = await self.ask(Opcode.WRITE_FILE, data, offset=offset)
        return await self.ask(Opcode.TERMINATE_SESSION) and done

    async def remove(self, path: bytes) -> None:
        """Remove a file. Raises Gone if it is not there."""

        async def attempt() -> bool:
            if path[len(self._here.root) :] not in self._here.files():
                raise Gone
            return await self.ask(Opcode.REMOVE_FILE, path)

        await self.insist(attempt)

    async def insist(self, attempt: Callable[[], Awaitable[bool]]) -> None:
        """Try until it is done: somebody else may have the session."""
        for _ in range(PATIENCE):
            if await attempt():
                return
            await trio.sleep(2.0)
        raise AssertionError("the other client was never served")


# --- another client of the vehicle


def replacing(heard: bool) -> Callable[[Scene], Awaitable[None]]:
    """Return what puts another file in the place of the file, by a rename. Where the server does not rename
    over a file, the client removes the file before each try, because the mount may have placed its own."""

    async def act(scene: Scene) -> None:
        here, temporary = scene.here, b"/theirs"
        if not heard:
            here.replace(FILE, THEIRS)
            scene.effect()
            return
        here.put(temporary, THEIRS)
        client = OtherClient(here, heard)

        async def attempt() -> bool:
            if PROFILES[here.profile].storage is not Storage.POSIX:
                with suppress(Gone):
                    await client.remove(here.root + FILE)
            return await client.ask(Opcode.RENAME, here.root + temporary + b"\0" + here.root + FILE)

        await client.insist(attempt)
        scene.effect()

    return act


def removing(heard: bool) -> Callable[[Scene], Awaitable[None]]:
    """Return what removes the file."""

    async def act(scene: Scene) -> None:
        here = scene.here
        if heard:
            await OtherClient(here, heard).remove(here.root + FILE)
        elif FILE in here.files():
            here.take(FILE)
        else:
            raise Gone
        scene.effect()

    return act


def lengthening(heard: bool) -> Callable[[Scene], Awaitable[None]]:
    """Return what appends to the file, as a logger does."""

    async def act(scene: Scene) -> None:
        here = scene.here
        client = OtherClient(here, heard)

        async def attempt() -> bool:
            files = here.files()
            if FILE not in files:
                raise Gone
            if not heard:
                here.put(FILE, files[FILE] + MORE)
                return True
            return await client.write(here.root + FILE, Opcode.OPEN_FILE_WO, len(files[FILE]), MORE)

        await client.insist(attempt)
        scene.effect()

    return act


def uploading(heard: bool) -> Callable[[Scene], Awaitable[None]]:
    """Return another computer's mavftpfs, which uploads a file for five minutes over a slow radio. Where a
    file stays open for so long, it begins again if the server closed it, because our Terminate was on its way
    when it opened the file."""

    async def act(scene: Scene) -> None:
        here = scene.here
        client, temporary = OtherClient(here, heard), here.root + D + b"/.mavftpfs-zzzznabc"
        pieces = [(at, BESIDE[at : at + PIECE]) for at in range(0, len(BESIDE), PIECE)]
        pause = TAKES * PIECE / len(BESIDE)

        async def in_one_session() -> bool:
            if not await client.ask(Opcode.CREATE_FILE, temporary):
                return False
            for at, piece in pieces:
                if not await client.ask(Opcode.WRITE_FILE, piece, offset=at):
                    return False
                await trio.sleep(pause)
            return await client.ask(Opcode.TERMINATE_SESSION)

        if PROFILES[here.profile].write_only_truncates:
            await client.insist(in_one_session)
        else:
            for at, piece in pieces:
                opcode = Opcode.OPEN_FILE_WO if at else Opcode.CREATE_FILE
                await client.insist(partial(client.write, temporary, opcode, at, piece))
                await trio.sleep(pause)
        assert await client.ask(Opcode.RENAME, temporary + b"\0" + here.root + D + b"/theirs")

    return act


# --- another program of this mount


async def open_too(scene: Scene) -> None:
    """Read the file."""
    scene.saw = await read(scene.tree)


async def rename_too(scene: Scene) -> None:
    """Give the file another name."""
    await scene.tree.rename(FILE, b"/d/moved")


async def empty_too(scene: Scene) -> None:
    """Empty the file."""
    await (await scene.tree.open(FILE, write=True, truncate=True)).release()


async def remove_too(scene: Scene) -> None:
    """Remove the file."""
    await scene.tree.unlink(FILE)


async def fail_to_remove_too(scene: Scene) -> None:
    """Remove the file, which the vehicle refuses. What is on its way goes on."""
    scene.here.faults.refuse(Opcode.REMOVE_FILE, NakCode.FAIL_ERRNO, errno.EACCES, times=10)
    await scene.tree.unlink(FILE)


async def give_up_removing_too(scene: Scene) -> None:
    """Begin to remove the file, and be interrupted at once."""
    with trio.move_on_after(0.001) as scope:
        await scene.tree.unlink(FILE)
    if scope.cancelled_caught:
        raise Interrupted


def _clients() -> list[Others]:
    return [
        Others(f"{verb}_{'heard' if heard else 'unheard'}", model, act(heard), outside=True)
        for heard in (True, False)
        for verb, model, act in (
            ("replaced", making(NAME, THEIRS), replacing),
            ("removed", taking(NAME), removing),
            ("lengthened", rewriting(lambda old: old + MORE), lengthening),
            ("beside", making(b"theirs", BESIDE), uploading),
        )
    ]


OTHERS = [
    *_clients(),
    Others("open_too", keeping, open_too),
    Others("rename_too", taking(NAME, b"moved"), rename_too),
    Others("empty_too", rewriting(lambda _: b""), empty_too),
    Others("remove_too", taking(NAME), remove_too),
    Others("fail_to_remove_too", keeping, fail_to_remove_too),
    Others("give_up_removing_too", taking(NAME), give_up_removing_too),
]
