"""`@PARAM/param.pck`: the packed file of all parameters. Layer: parameters; pure.

Source: docs/servers.md 17. A header of three 16-bit numbers: magic, entries in this file, and in a download
the vehicle's parameters, in an upload the file's length. An entry is a byte of type (low half) and flags,
one of the length of the name's beginning that it shares with the entry before (low half) and of the rest
less one, that rest, the value, and with flag 1 the default. Zeros before an entry are padding. All is
little-endian.

A vehicle may send anything: an inconsistent file is an error.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from mavftpfs.parameters.values import WIDTHS, Kind, Parameter
from mavftpfs.shared.errors import RemoteProtocolError

MAGIC = 0x671B
MAGIC_DEFAULTS = 0x671C
"""The magic of a file in which defaults may follow values."""

HEADER = struct.Struct("<HHH")
_DEFAULT = 1
_MAX_SHARED = 15
_VALUES = {
    Kind.INT8: struct.Struct("<b"),
    Kind.INT16: struct.Struct("<h"),
    Kind.INT32: struct.Struct("<i"),
    Kind.FLOAT: struct.Struct("<f"),
}
_BY_TYPE = {int(kind): (kind, WIDTHS[kind], _VALUES[kind].unpack_from) for kind in Kind}
_NAME = re.compile(rb"(?![^,#=]*[,#=])[!-~]{1,16}")
"""A name without the characters that would end it in a text."""


@dataclass(frozen=True, slots=True)
class Download:
    """The content of a packed file.

    total: the number of the vehicle's parameters. with_defaults: a parameter without a default has its value
    as the default.
    """

    parameters: list[Parameter]
    total: int
    with_defaults: bool


def unpack(data: bytes) -> Download:
    """Parse a download.

    Raises:
        RemoteProtocolError: the file is inconsistent.
    """
    if len(data) < HEADER.size:
        raise RemoteProtocolError(f"a parameter file of {len(data)} bytes has no header")
    magic, count, total = HEADER.unpack_from(data)
    if magic not in (MAGIC, MAGIC_DEFAULTS):
        raise RemoteProtocolError(f"a parameter file does not begin with {magic:#06x}")
    found: dict[str, Parameter] = {}
    at, last = HEADER.size, b""
    for _ in range(count):
        parameter, last, at = _unpack_entry(data, at, last)
        if parameter.name in found:
            raise RemoteProtocolError(f"the parameter file has {parameter.name} twice")
        found[parameter.name] = parameter
    if data.count(0, at) != len(data) - at:
        raise RemoteProtocolError(f"the parameter file has more than the {count} entries that it announces")
    if count > total:
        raise RemoteProtocolError(f"the parameter file has {count} entries of {total} parameters")
    return Download(list(found.values()), total, magic == MAGIC_DEFAULTS)


def _unpack_entry(data: bytes, at: int, last: bytes) -> tuple[Parameter, bytes, int]:
    """Parse the entry at a place; return it, its name, and the place behind it."""
    try:
        while not data[at]:
            at += 1
        kind, width, read = _BY_TYPE[data[at] & 15]
        flags, shared, rest = data[at] >> 4, data[at + 1] & 15, (data[at + 1] >> 4) + 1
        start = at + 2 + rest
        name = last[:shared] + data[at + 2 : start]
        if flags > _DEFAULT or shared > len(last) or not _NAME.fullmatch(name):
            raise RemoteProtocolError(f"the parameter file is damaged at byte {at}")
        value = read(data, start)[0]
        if not flags:
            return Parameter(name.decode("ascii"), kind, value), name, start + width
        default = read(data, start + width)[0]
        return Parameter(name.decode("ascii"), kind, value, default), name, start + 2 * width
    except (IndexError, struct.error):
        raise RemoteProtocolError("the parameter file ends before its last entry") from None
    except KeyError:
        raise RemoteProtocolError(f"the parameter file has an unknown type at byte {at}") from None


def pack_upload(parameters: Sequence[Parameter]) -> list[bytes]:
    """Return an upload that sets these values, in pieces that no request may split: the header with the
    first entry, then one entry each.

    If an upload ends early, the vehicle may apply the part that arrived (ArduPilot fills the rest with
    zeros). It would set a value that arrived in part to something else.
    """
    entries = list(_entries(parameters))
    length = HEADER.size + sum(map(len, entries))
    header = HEADER.pack(MAGIC, len(entries), length)
    return [header + entries[0], *entries[1:]] if entries else [header]


def _entries(parameters: Sequence[Parameter]) -> Iterator[bytes]:
    last = b""
    for parameter in parameters:
        name = parameter.name.encode("ascii")
        shared = _shared(last, name)
        lengths = shared | (len(name) - shared - 1) << 4
        value = _VALUES[parameter.kind].pack(parameter.value)
        yield bytes([parameter.kind, lengths]) + name[shared:] + value
        last = name


def _shared(last: bytes, name: bytes) -> int:
    """Return how many bytes a name shares with the one before; the last byte is never shared."""
    most = min(len(last), len(name) - 1, _MAX_SHARED)
    return next((place for place in range(most) if last[place] != name[place]), max(most, 0))
