"""Names on the vehicle: their spellings, ls, mkdir, rmdir, rm, mv; and crc. Layer: client; silent."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from fnmatch import fnmatchcase

from mavftpfs.cache.attributes import Stat
from mavftpfs.client.files import READ_SIZE, File, Files, Session, is_directory, reading, walk, written
from mavftpfs.client.status import Facts
from mavftpfs.protocol.url import MftpUrl, is_url, parse_url
from mavftpfs.shared import readonly
from mavftpfs.shared.errors import (
    CrossDevice,
    DataUnproven,
    InvalidMove,
    IsADirectory,
    LocalProtocolError,
    NotADirectory,
    NotFound,
    ReadOnly,
    UsageError,
)
from mavftpfs.shared.model import ROOT, EntryKind, is_virtual, join, normalise, split
from mavftpfs.shared.readable import name_text


def parse_paths(texts: Sequence[str]) -> tuple[list[bytes], int | None]:
    """Return the normalised remote paths, and the component that mftp:// URLs among them name.

    Raises:
        UsageError: `..` or NUL, a malformed URL, or two components at once.
    """
    paths, components = [], set()
    for text in texts:
        url = parse_url(text) if is_url(text) else MftpUrl(None, _plain_path(text))
        paths.append(url.path)
        components |= {url.component} - {None}
    if len(components) > 1:
        raise UsageError("the URLs name several components; ask one at a time")
    return paths, components.pop() if components else None


def _plain_path(text: str) -> bytes:
    try:
        return normalise(os.fsencode(text))
    except LocalProtocolError as exc:
        raise UsageError(str(exc)) from exc


def is_pattern(name: bytes) -> bool:
    """Return whether a name has wildcards."""
    return re.search(rb"[*?[]", name) is not None


def fixed_part(pattern: bytes) -> bytes:
    """Return the directory above the first part of a pattern that has wildcards."""
    fixed = ROOT
    for part in pattern.strip(b"/").split(b"/"):
        if is_pattern(part):
            break
        fixed = join(fixed, part)
    return fixed


async def matching(files: Files, path: bytes) -> list[bytes]:
    """Return the paths that match a pattern as in a shell, sorted; or the path itself, if it exists or is not
    a pattern.

    Raises:
        NotFound: nothing matches. Otherwise as Files.list.
    """
    if not is_pattern(path) or await _exists(files, path):
        return [path]
    found = [ROOT]
    for part in path.strip(b"/").split(b"/"):
        found = [join(top, name) for top in found for name in await _names_like(files, top, part)]
    if not found:
        raise NotFound(f"nothing matches {name_text(path)}")
    return sorted(found)


async def all_matching(files: Files, paths: Sequence[bytes]) -> list[bytes]:
    """Return the paths that match several patterns, each path once. Raises: as `matching`."""
    found = [name for path in paths for name in await matching(files, path)]
    return list(dict.fromkeys(found))


async def matching_files(files: Files, path: bytes, tell: Callable[[str], None]) -> list[bytes]:
    """Return the paths of `matching`, without the directories that a pattern matches; `tell` of each
    directory.

    Raises:
        IsADirectory: a pattern matches only directories. Otherwise as `matching`.
    """
    found = await matching(files, path)
    if found == [path]:
        return found
    directories = [name for name in found if await is_directory(files, name)]
    if directories == found:
        raise IsADirectory(f"{name_text(path)} matches only directories")
    for name in directories:
        tell(f"{name_text(name)} is a directory, and was left out")
    return [name for name in found if name not in directories]


async def _exists(files: Files, path: bytes) -> bool:
    try:
        await files.stat(path)
    except (NotFound, NotADirectory):
        return False
    return True


async def _names_like(files: Files, directory: bytes, pattern: bytes) -> list[bytes]:
    if not is_pattern(pattern):
        return [pattern] if await _exists(files, join(directory, pattern)) else []
    if not await is_directory(files, directory):
        return []
    names = [name for name, _ in await files.list(directory)]
    hidden = pattern.startswith(b".")
    return [name for name in names if fnmatchcase(name, pattern) and (hidden or not name.startswith(b"."))]


Listing = tuple[str | None, list[Facts]]
"""A directory's name and its entries; None: the path is a file, the only entry."""


async def list_paths(session: Session, paths: Sequence[bytes], *, recursive: bool = False) -> list[Listing]:
    """Return the entries of directories, and files themselves, as JSON-able facts."""
    return [listing for path in paths for listing in await _list_path(session.files, path, recursive)]


async def _list_path(files: Files, path: bytes, recursive: bool) -> list[Listing]:
    found = await files.stat(path)
    if found.kind is EntryKind.FILE:
        return [(None, [_facts(path, split(path)[1], found)])]
    listings: list[Listing] = []
    pending = [path]
    while pending:
        here = pending.pop()
        below = sorted(await files.list(here), key=lambda entry: entry[0])
        listings.append((name_text(here), [_facts(join(here, name), name, stat) for name, stat in below]))
        if recursive:
            inner = [join(here, name) for name, stat in below if stat.kind is EntryKind.DIRECTORY]
            pending += reversed(inner)
    return listings


def _facts(path: bytes, name: bytes, found: Stat) -> Facts:
    return {
        "path": path.decode("utf-8", "surrogateescape"),
        "name": name.decode("utf-8", "surrogateescape"),
        "kind": found.kind.name.lower(),
        "size": found.size,
        "mtime": found.mtime,
    }


async def checksum_paths(
    session: Session,
    paths: Sequence[bytes],
    tell: Callable[[bytes, int], None],
    complain: Callable[[str], None],
) -> None:
    """Have the vehicle compute CRC32s of files and of those that patterns match; `tell(path, crc)` for each.

    Raises:
        IsADirectory. Otherwise as matching_files, Files.stat and crc32.
    """
    found = [name for path in paths for name in await matching_files(session.files, path, complain)]
    for path in dict.fromkeys(found):
        if (await session.files.stat(path)).kind is not EntryKind.FILE:
            raise IsADirectory(f"{name_text(path)} is a directory")
        tell(path, await session.files.crc32(path))


async def emptied(files: Files, path: bytes) -> File:
    """Open a file for writing from its start. The file on the vehicle stays until the new one is complete."""
    try:
        return await files.open(path, write=True, truncate=True)
    except NotFound:
        return await files.create(path, exclusive=False)


async def make_directory(files: Files, path: bytes, *, may_exist: bool) -> None:
    """Make one directory. may_exist: an existing directory is fine, and stays as it is.

    Raises:
        AlreadyExists: the name is taken (with `may_exist`: by a file).
    """
    if not (may_exist and await is_directory(files, path)):
        await files.mkdir(path)


async def make_directories(session: Session, paths: Sequence[bytes], *, parents: bool) -> None:
    """Make directories; with `parents` also those above them, and existing ones are fine.

    Raises:
        As make_directory and Files.mkdir.
    """
    for path in paths:
        for wanted in [*ancestors(path), path] if parents else [path]:
            await make_directory(session.files, wanted, may_exist=parents)


def ancestors(path: bytes) -> list[bytes]:
    """Return the directories above a path, the topmost first, without the root."""
    found = []
    while (path := split(path)[0]) != ROOT:
        found.append(path)
    return found[::-1]


async def remove_directories(session: Session, paths: Sequence[bytes]) -> None:
    """Remove empty directories.

    Raises:
        UsageError: the root. Otherwise as Files.rmdir.
    """
    refuse_root(paths)
    for path in paths:
        await session.files.rmdir(path)


def refuse_root(paths: Sequence[bytes]) -> None:
    """Check that the paths do not name the root, and with it everything.

    Raises:
        UsageError: the root is named.
    """
    if ROOT in paths:
        raise UsageError("the root itself cannot be removed; name the files and directories in it")


async def remove_paths(session: Session, paths: Sequence[bytes], *, recursive: bool) -> None:
    """Remove files, and with `recursive` directories with everything below.

    Raises:
        IsADirectory: a directory without `recursive`; ReadOnly: a path that the vehicle generates. The
            function looks at all paths before it removes the first one.
    """
    found = [(path, await session.files.stat(path)) for path in paths]
    for path, stat in found:
        if stat.kind is EntryKind.DIRECTORY and not recursive:
            raise IsADirectory(f"{name_text(path)} is a directory; remove it with -r")
        if is_virtual(session.on_vehicle(path)):
            raise ReadOnly(readonly.virtual(path))
    for path, stat in found:
        await _remove(session.files, path, stat.kind)


async def _remove(files: Files, path: bytes, kind: EntryKind) -> None:
    """Remove a file, or a directory from its leaves upwards."""
    if kind is EntryKind.FILE:
        await files.unlink(path)
        return
    found, unlisted = await walk(files, path)
    for _, error in unlisted:
        raise error
    for below, stat in reversed(found):
        await (files.unlink if stat.kind is EntryKind.FILE else files.rmdir)(join(path, below))
    await files.rmdir(path)


async def require_directory(files: Files, path: bytes) -> None:
    """Check that a path, written with a `/` at its end, is a directory.

    Raises:
        NotADirectory, NotFound: it is not.
    """
    try:
        kind = (await files.stat(path)).kind
    except NotFound:
        raise NotFound(f"{name_text(path)}/: there is no such directory") from None
    if kind is not EntryKind.DIRECTORY:
        raise NotADirectory(f"{name_text(path)}/ is not a directory")


async def move_paths(session: Session, paths: Sequence[bytes], to: bytes, *, into: bool = False) -> None:
    """Move things into the directory `to`, or one thing to that name.

    into: `to` was written with a `/` at its end: a file goes into that directory only.

    Raises:
        NotADirectory: several things, or a file with `into`, and `to` is not a directory; NotFound: `to` does
        not exist. Otherwise as Files.rename.
    """
    inside = await is_directory(session.files, to)
    if not inside and len(paths) > 1:
        raise NotADirectory(f"{name_text(to)} is not a directory, so only one thing can be moved there")
    if into and not inside and not await is_directory(session.files, paths[0]):
        await require_directory(session.files, to)
    for path in paths:
        await move(session.files, path, join(to, split(path)[1]) if inside else to)


async def move(files: Files, old: bytes, new: bytes) -> None:
    """Rename. If the server cannot, copy the file, verify it and delete the old one, as mv does between
    disks.

    Raises:
        InvalidMove: the root. Otherwise as Files.rename and copy.
    """
    if old == ROOT:  # where the server cannot rename, the root would be copied into itself
        raise InvalidMove("the root itself cannot be moved")
    try:
        await files.rename(old, new)
        return
    except CrossDevice:
        found = await files.stat(old)
    if found.kind is EntryKind.FILE:
        await copy(files, old, new)
        await files.unlink(old)
        return
    await make_directory(files, new, may_exist=False)
    for name, _ in await files.list(old):
        await move(files, join(old, name), join(new, name))
    await files.rmdir(old)


async def copy(files: Files, old: bytes, new: bytes) -> None:
    """Copy a file through this computer, which verifies it.

    Raises:
        InvalidMove: onto itself. NotDelivered. Otherwise as Files.open.
    """
    if old == new:  # opening the new file for writing would empty the old one
        raise InvalidMove(f"{old!r} cannot be copied onto itself")
    async with reading(files, old) as source:
        file = await emptied(files, new)
        async with written(file):
            offset = 0
            while offset < source.size:
                data = bytes(await source.read(offset, READ_SIZE))
                if not data:
                    raise DataUnproven(f"{name_text(old)} ended at {offset} of {source.size} bytes")
                offset += await file.write(offset, data)
