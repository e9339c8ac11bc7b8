"""The rows of the matrix: what a program does, and a model of what that does to a directory."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager, suppress

import pytest
import trio

from mavftpfs.cache.openfile import OpenFile
from mavftpfs.cache.tree import Tree
from mavftpfs.shared.errors import FileTooLarge, MavftpfsError, WriteFailed
from mavftpfs.sim.profiles import PROFILES, Storage
from tests.support.transfers import content

State = dict[bytes, bytes | None]
"""The directory: contents of files by name, None for a directory."""

Model = Callable[[State], State | None]
"""The effect of a call on a directory of a local disk; None if the call fails there."""

Call = Callable[[Tree], Awaitable[object]]
"""The calls of a program. One that reads returns what it saw."""

D = b"/d"
FILE, NAME = b"/d/file", b"file"
OLD, OTHER, NEW, LARGE = content(900, 1), content(400, 2), content(700, 3), content(70_000, 4)
BEFORE: State = {NAME: OLD, b"other": OTHER, b"sub": None}


# --- what programs do


_TAKEN = "all writes of the program were taken"


@contextmanager
def taken() -> Iterator[None]:
    """Mark what ends the body: before it, all writes of the program were taken."""
    try:
        yield
    except BaseException as error:
        error.add_note(_TAKEN)
        raise


def is_taken(error: BaseException) -> bool:
    """Return whether a call ended like this after all its writes were taken."""
    return _TAKEN in getattr(error, "__notes__", ())


async def write(tree: Tree, path: bytes, offset: int, data: bytes, *, truncate: bool = False) -> None:
    """Open, write, close: what a program does that checks its close()."""
    file = await tree.open(path, write=True, truncate=truncate)
    try:
        await file.write(offset, data)
        with taken():
            await file.flush()
    finally:
        await file.release()


async def list_names(tree: Tree) -> frozenset[bytes]:
    """Run ls, when what was listed before is too old."""
    tree.forget_caches()
    return frozenset([name for name, _ in await tree.list(D)])


async def read(tree: Tree) -> bytes:
    """Run cat."""
    file = await tree.open(FILE)
    try:
        return bytes(await file.read(0, 2 * len(LARGE)))
    finally:
        await file.release()


async def create(tree: Tree) -> None:
    """Run cp to a new name."""
    file = await tree.create(b"/d/new", exclusive=False)
    try:
        await file.flush()  # as a shell does before a program writes
        await file.write(0, NEW)
        with taken():
            await file.flush()
    finally:
        await file.release()


async def touch(tree: Tree) -> None:
    """Make an empty file."""
    await (await tree.create(b"/d/new", exclusive=True)).release()


async def replace(tree: Tree) -> None:
    """Run cp over a file."""
    await write(tree, FILE, 0, NEW, truncate=True)


async def change(tree: Tree) -> None:
    """Write some bytes in the middle."""
    await write(tree, FILE, 200, NEW[:100])


async def append(tree: Tree) -> None:
    """Run echo >> file."""
    file = await tree.open(FILE, write=True)
    try:
        await file.write(file.size, NEW)
        with taken():
            await file.flush()
    finally:
        await file.release()


async def append_in_doubt(tree: Tree) -> None:
    """Run echo >> file, while an unexplained answer makes all answers suspect (see `meet`)."""
    await append(tree)


async def sync(tree: Tree) -> None:
    """Replace a file, and have fsync() confirm it while the file stays open."""
    file = await tree.open(FILE, write=True, truncate=True)
    try:
        await file.write(0, NEW)
        with taken():
            await file.fsync()
    finally:
        await file.release()


async def take_back(tree: Tree) -> bool | None:
    """Begin to replace a file, and take the bytes back, as `put` does after Ctrl-C."""
    file = await tree.open(FILE, write=True, truncate=True)
    try:
        await file.write(0, LARGE)
        await trio.sleep(0.1)
    except BaseException:
        await file.take_back()
        raise
    return await file.take_back()


async def fail(file: OpenFile) -> None:
    """Have a program told that a write failed, while a part of the file is on its way, and close."""
    try:
        await file.write(0, LARGE)
        await trio.sleep(0.1)
        with pytest.raises(FileTooLarge):
            await file.write(1 << 32, b"beyond the end of what a vehicle takes")
        with pytest.raises(WriteFailed):
            await file.flush()
    finally:
        with suppress(MavftpfsError):
            await file.release()


async def fail_to_create(tree: Tree) -> None:
    """Run cp to a new name; a write is refused."""
    await fail(await tree.create(b"/d/new", exclusive=False))


async def fail_to_replace(tree: Tree) -> None:
    """Run cp over a file; a write is refused."""
    await fail(await tree.open(FILE, write=True, truncate=True))


async def truncate(tree: Tree) -> None:
    """Run truncate -s."""
    await tree.truncate(FILE, 300)


async def rename(tree: Tree) -> None:
    """Run mv to a free name."""
    await tree.rename(FILE, b"/d/new")


async def rename_over(tree: Tree) -> None:
    """Run mv over a file."""
    await tree.rename(FILE, b"/d/other")


async def rename_over_open(tree: Tree) -> None:
    """Run mv over a file that a program reads."""
    file = await tree.open(b"/d/other")
    try:
        await rename_over(tree)
    finally:
        await file.release()


async def unlink(tree: Tree) -> None:
    """Run rm."""
    await tree.unlink(FILE)


async def mkdir(tree: Tree) -> None:
    """Run mkdir."""
    await tree.mkdir(b"/d/new")


async def rmdir(tree: Tree) -> None:
    """Run rmdir."""
    await tree.rmdir(b"/d/sub")


# --- what that does to a directory


def keeping(state: State) -> State:
    """Change nothing."""
    return state


def making(name: bytes, data: bytes | None) -> Model:
    """Return a model that puts a file or directory there, also over a file."""
    return lambda state: state | {name: data}


def rewriting(contents: Callable[[bytes], bytes]) -> Model:
    """Return a model that changes what the file holds, if it is there."""
    return lambda state: state | {NAME: contents(state[NAME] or b"")} if NAME in state else None


def taking(name: bytes, target: bytes | None = None) -> Model:
    """Return a model that removes a name, or gives another one to what it has."""

    def take(state: State) -> State | None:
        if name not in state:
            return None
        left = {key: data for key, data in state.items() if key != name}
        return left if target is None else left | {target: state[name]}

    return take


appending = rewriting(lambda old: old + NEW)

OPERATIONS: dict[Call, Model] = {
    list_names: keeping,
    read: keeping,
    create: making(b"new", NEW),
    touch: making(b"new", b""),
    replace: rewriting(lambda _: NEW),
    change: rewriting(lambda old: old[:200].ljust(200, b"\0") + NEW[:100] + old[300:]),
    append: appending,
    append_in_doubt: appending,
    sync: rewriting(lambda _: NEW),
    take_back: keeping,
    fail_to_create: keeping,
    fail_to_replace: keeping,
    truncate: rewriting(lambda old: old[:300].ljust(300, b"\0")),
    rename: taking(NAME, b"new"),
    rename_over: taking(NAME, b"other"),
    rename_over_open: taking(NAME, b"other"),
    unlink: taking(NAME),
    mkdir: making(b"new", None),
    rmdir: taking(b"sub"),
}

VIEWS: dict[Call, Callable[[State], object]] = {
    list_names: frozenset,
    read: lambda state: state.get(NAME),
}
"""Return what a call sees of a directory."""

FAILING = (fail_to_create, fail_to_replace)
RENAMES = (rename, rename_over, rename_over_open)
IN_PLACE = (create, replace, change, append, append_in_doubt, sync, truncate, fail_to_create)
"""Work byte by byte where the server cannot rename."""

WRITING = (*IN_PLACE, take_back, fail_to_replace)
KEEPING_NEW = (create, replace, change, append, append_in_doubt, sync)
"""Write the first bytes of NEW. The program is told that they arrived, or they are kept here."""

ON_THE_WAY: dict[Call, tuple[bytes, ...]] = {
    replace: (b"",),
    sync: (b"",),
    take_back: (b"", LARGE),
    fail_to_replace: (b"", LARGE),
}
"""Return what another program of the same mount may read beside the old and the new content."""


def after(operation: Call) -> State:
    """Return what the directory holds after an operation beside which nothing happened."""
    state = OPERATIONS[operation](BEFORE)
    assert state is not None
    return state


def allowed(operation: Call) -> tuple[State, ...]:
    """Return what may be there while the outcome is open: all, nothing, or the empty file cp begins with."""
    begun = (BEFORE | {b"new": b""},) if operation is create else ()
    return BEFORE, after(operation), *begun


def in_place(profile: str) -> bool:
    """Return whether files are changed where they are: nothing can be renamed."""
    return PROFILES[profile].storage is Storage.LITTLEFS
