"""The messages about files between commands and a mount's process, as bytes. Layer: client; pure.

A connection to the control socket begins with one line of JSON each way (client.control). The client's line
asks for `files`. From then on the client sends requests, and the mount's process answers each of them, in
order, with one reply. Both are messages: two lengths, a JSON object of the first length, and bytes of the
second length.

A connection has at most one open file. A request that arrives while the process answers the previous one
cancels that one. When a connection ends, the process discards the changes that were written and not released.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from typing import Any, NamedTuple

from mavftpfs.cache.attributes import Stat
from mavftpfs.shared import errors
from mavftpfs.shared.errors import ListingIncomplete, MavftpfsError, RemoteProtocolError
from mavftpfs.shared.model import EntryKind

VERSION = 1
"""The version of this protocol. Commands and mounts of different versions refuse each other; `status` and
`umount` are lines of their own, which never change."""

BLOCK = 128 * 1024
"""Bytes of a file in one message."""
MAX_REPLY = 64 << 20
"""Bytes of a reply, large enough for a large directory."""
_MAX_FACTS = 64 * 1024
_LENGTHS = struct.Struct(">II")

Facts = dict[str, Any]


class Message(NamedTuple):
    """A request or a reply: JSON-able facts, and bytes."""

    facts: Facts
    data: bytes = b""


class Messages:
    """Takes the bytes of a connection, and gives out messages.

    most: the largest number of bytes in `facts` or `data` of a message.
    """

    def __init__(self, *, most: int) -> None:
        self._most = most
        self._received = bytearray()

    def feed(self, data: bytes) -> None:
        """Take bytes that arrived."""
        self._received += data

    def next(self) -> Message | None:
        """Return the next message, None if more bytes must arrive first.

        Raises:
            RemoteProtocolError: these bytes are not a message.
        """
        start = _LENGTHS.size
        if len(self._received) < start:
            return None
        lengths = _LENGTHS.unpack_from(self._received)
        if max(lengths) > self._most:
            raise RemoteProtocolError(f"a message of {max(lengths)} bytes")
        middle, stop = start + lengths[0], start + sum(lengths)
        if len(self._received) < stop:
            return None
        with memoryview(self._received) as view:
            head, data = bytes(view[start:middle]), bytes(view[middle:stop])
        del self._received[:stop]
        return Message(_facts(head), data)


def requests() -> Messages:
    """Return a parser of a client's bytes."""
    return Messages(most=max(BLOCK, _MAX_FACTS))


def replies() -> Messages:
    """Return a parser of the bytes from a mount's process."""
    return Messages(most=MAX_REPLY)


def _facts(head: bytes) -> Facts:
    try:
        facts = json.loads(head)
    except (ValueError, RecursionError):
        facts = None
    if not isinstance(facts, dict):
        raise RemoteProtocolError("a message without facts")
    return facts


def encoded(facts: Facts, data: bytes | memoryview = b"") -> bytes:
    """Return a message as bytes."""
    head = json.dumps(facts, default=str).encode()
    return b"".join((_LENGTHS.pack(len(head), len(data)), head, data))


def text(path: bytes) -> str:
    """Return a path in a form that JSON can carry."""
    return path.decode("utf-8", "surrogateescape")


def path(told: object) -> bytes:
    """Return a path that was sent as text.

    Raises:
        RemoteProtocolError: the value is not text.
    """
    if not isinstance(told, str):
        raise RemoteProtocolError("a path that is not text")
    return told.encode("utf-8", "surrogateescape")


# -- attributes -----------------------------------------------------------------------------------


def told_stat(stat: Stat) -> list[Any]:
    """Return attributes in a form that JSON can carry."""
    return [stat.kind.value, stat.size, stat.mtime_ns, stat.valid_for]


def stat_from(told: Sequence[Any]) -> Stat:
    """Return attributes that `told_stat` made."""
    kind, *rest = told
    return Stat(EntryKind(kind), *rest)


def told_entries(entries: Sequence[tuple[bytes, Stat]]) -> bytes:
    """Return a directory's entries as the bytes of a message."""
    return json.dumps([[text(name), *told_stat(stat)] for name, stat in entries]).encode()


def entries_from(data: bytes) -> list[tuple[bytes, Stat]]:
    """Return the entries that `told_entries` made."""
    return [(path(name), stat_from(rest)) for name, *rest in json.loads(data)]


# -- errors ---------------------------------------------------------------------------------------

_KINDS = {
    name: kind
    for name, kind in vars(errors).items()
    if isinstance(kind, type) and issubclass(kind, MavftpfsError)
}


def told_error(error: MavftpfsError) -> Message:
    """Return the reply for an error: its class, its text and its attributes."""
    kind = next(kind.__name__ for kind in type(error).__mro__ if kind.__name__ in _KINDS)
    known = {name: value for name, value in vars(error).items() if isinstance(value, int | str | None)}
    entries = told_entries(error.entries) if isinstance(error, ListingIncomplete) else b""
    return Message({"error": kind, "text": str(error), "attributes": known}, entries)


def error_from(reply: Message) -> MavftpfsError:
    """Return the error that `told_error` made."""
    kind = _KINDS.get(reply.facts["error"], MavftpfsError)
    error = kind.__new__(kind, reply.facts["text"])  # some classes make their text of other arguments
    vars(error).update(reply.facts["attributes"])
    if isinstance(error, ListingIncomplete):
        error.entries = entries_from(reply.data)
    return error
