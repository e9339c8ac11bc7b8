"""Entries of listings, spellings of paths, and traits of servers. Layer: shared; pure.

Paths are bytes, absolute in the *mount's* spelling: `/a/b`, `/@SYS/uarts.txt`; the root is `/`.
`wire_path` gives the server's spelling: virtual trees have no leading slash (servers.md 11).
"""

from __future__ import annotations

from collections.abc import MutableMapping
from dataclasses import dataclass, fields
from enum import Enum
from typing import TypeVar

from mavftpfs.shared.errors import LocalProtocolError, PathTooLong

MAX_WIRE_PATH = 200
"""Bytes of a path that fit every known server with room to spare (servers.md 14.33)."""

RENAME_ROOM = 238
"""Bytes that both paths of a rename and the NUL between them may have (servers.md 9)."""

ROOT = b"/"

T = TypeVar("T")


class EntryKind(Enum):
    """The kind of a directory entry."""

    FILE = "F"
    DIRECTORY = "D"


@dataclass(frozen=True, slots=True)
class DirEntry:
    """One listed name. size: bytes, 0 for directories. mtime: seconds UTC, None if the server reports no
    times."""

    name: bytes
    kind: EntryKind
    size: int = 0
    mtime: int | None = None


@dataclass(frozen=True, slots=True)
class Listing:
    """A whole directory, without duplicates and unusable names.

    took: seconds that the sweep needed. complete: False if the vehicle did not show everything, so that
    absence proves nothing. end: see ListDirectory.
    """

    entries: tuple[DirEntry, ...]
    took: float
    complete: bool = True
    end: int | None = None


def join(parent: bytes, name: bytes) -> bytes:
    """Return the path of `name` in the directory `parent`."""
    return parent + name if parent.endswith(b"/") else parent + b"/" + name


def split(path: bytes) -> tuple[bytes, bytes]:
    """Return (parent, name) of an absolute path; the root gives (b"/", b"")."""
    parent, _, name = path.rstrip(b"/").rpartition(b"/")
    return (parent or ROOT, name)


def renamed(path: bytes, old: bytes, new: bytes) -> bytes:
    """Return the path that `path` has after `old` was renamed to `new`."""
    return new + path[len(old) :] if path == old or path.startswith(old + b"/") else path


def rename_keys(facts: MutableMapping[bytes, T], old: bytes, new: bytes) -> None:
    """Move the entries of a path, and of all paths below it, to their new names."""
    for path in list(facts):
        now = renamed(path, old, new)
        if now != path:
            facts[now] = facts.pop(path)


def normalise(path: bytes) -> bytes:
    """Return the absolute path without empty and `.` parts.

    Raises:
        LocalProtocolError: the path contains `..` or a NUL (servers do not jail paths, servers.md 13).
    """
    parts = [part for part in path.split(b"/") if part not in (b"", b".")]
    if b".." in parts or b"\0" in path:
        raise LocalProtocolError(f"path {path!r} may contain neither '..' nor NUL")
    return b"/" + b"/".join(parts)


def is_virtual(path: bytes) -> bool:
    """Return whether the path lies in an `@` tree.

    Only the prefix decides (servers.md 14.13). A server without such trees may have an ordinary file `/@x`,
    but no listing distinguishes the two, and a write to `@PARAM` would change the vehicle.
    """
    return path.startswith(b"/@")


def is_on_nuttx(path: bytes) -> bool:
    """Return whether a path is below a storage of NuttX, which mounts them at /fs/NAME."""
    return path.startswith(b"/fs/")


def is_snapshot(path: bytes) -> bool:
    """Return whether the vehicle generates the `@` file at each opening, so that a client must read it whole.
    The logs below `@MAV_LOG` are real files. Those of `@ROMFS` resemble real files: their sizes are true, and
    they do not change."""
    return is_virtual(path) and path.split(b"/", 2)[1] not in (b"@MAV_LOG", b"@ROMFS")


def wire_path(path: bytes) -> bytes:
    """Return the server's spelling of a normalised path.

    Raises:
        PathTooLong: the path does not fit (servers cut it silently, servers.md 13).
    """
    wire = path[1:] if is_virtual(path) else path
    if len(wire) > MAX_WIRE_PATH:
        raise PathTooLong(f"path of {len(wire)} bytes is longer than the {MAX_WIRE_PATH} a vehicle takes")
    return wire


def require_listable(path: bytes) -> None:
    """Check that a listing could show a new name, because a file without a listing can be neither found nor
    removed.

    Raises:
        LocalProtocolError: the name contains a tab, which ends a name in a listing (servers.md 6, 14.33).
    """
    name = split(path)[1]
    if b"\t" in name:
        raise LocalProtocolError(f"{name!r} contains a tab, so no listing could show it")


def usable_name(name: bytes) -> bool:
    """Return whether a listed name may enter the tree (promise 10)."""
    return bool(name) and name not in (b".", b"..") and b"/" not in name and b"\0" not in name


# -- traits of a server ------------------------------------------------------------------------------
#
# None means "not seen yet". No trait is derived from a name or a version: the engine sets a field when a
# reply proves it, and forgets all of them when the vehicle restarts.

SHARED_QUEUE_WINDOW = 4
"""Requests in flight if the server has a queue of five for all clients (servers.md 3, ArduPilot)."""


@dataclass(slots=True)
class Traits:
    """Observed facts about one server; forgotten when the vehicle reboots.

    Attributes:
        ack_carries_own_session: an Open ACK carried the non-zero id that the request asked for (servers.md
            14.6); then every reply echoes the request's session, and the engine checks it.
        several_sessions: the server answered mavftpfs while another client had a session (ArduPilot,
            generation B).
        queue_limit: the most requests that may be in flight; None where no limit is known.
        write_ack_offset: WriteFile ACKs give the offset of the written bytes (MAVSDK's give 0), so an ACK
            counts only for that offset.
        paths_block_writes: a path operation made the server refuse the next write (PX4 on NuttX, servers.md
            8).
        lists_times: the server answers opcode 16. time_silences: how often the server did not answer opcode
            16, and then answered opcode 3.
        wo_truncates: OpenFileWO empties the file (servers.md 8).
        rename_works: a rename succeeded (False: LittleFS has none). Filled by the cache.
        rename_replaces: a rename onto an existing file worked (False: FAT refuses it). Filled by the cache.
    """

    ack_carries_own_session: bool | None = None
    several_sessions: bool = False
    queue_limit: int | None = None
    write_ack_offset: bool | None = None
    paths_block_writes: bool = False
    lists_times: bool | None = None
    time_silences: int = 0
    wo_truncates: bool | None = None
    rename_works: bool | None = None
    rename_replaces: bool | None = None

    def forget(self) -> None:
        """Forget all traits, because the server restarted, perhaps as another one."""
        for fact in fields(self):
            setattr(self, fact.name, fact.default)
