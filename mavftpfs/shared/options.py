"""The table of options: name, type, default and help, each in one place. Layer: shared; pure.

The fields of `Options` are the rows. `-o` text (`mount.options`), the library's keywords (`client.options`),
`--help`, the man page, completions and the guide's reference come from them. The session and the caches get
the same record, with what they add themselves.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal, NamedTuple, TypeVar

from mavftpfs.shared.errors import MavftpfsError, UsageError
from mavftpfs.shared.model import ROOT, normalise

_UNITS = {"": 1, "K": 1 << 10, "M": 1 << 20, "G": 1 << 30}
_DAY = 86400.0
_SIZE_MAX = 1 << 40

NumberT = TypeVar("NumberT", int, float)

# -- types ----------------------------------------------------------------------------------------

Parser = Callable[[str], Any]
"""Parses the text of a value; raises ValueError, which says what the text should be."""


class Type(NamedTuple):
    """Type of an option's values. written: returns a value in the spelling that `parse` accepts.

    is_file: values are paths on this computer.
    """

    parse: Parser
    written: Callable[[Any], str] = str
    is_file: bool = False


def _is_number(text: str) -> bool:
    return text.isascii() and text.isdigit()


def _with_unit(value: float) -> str:
    """Return a size in the spelling of the command line."""
    units = [(unit, factor) for unit, factor in _UNITS.items() if value and value % factor == 0]
    unit, factor = max(units, key=lambda pair: pair[1], default=("", 1))
    return f"{value // factor:.0f}{unit}"


def _within(value: NumberT, low: NumberT, high: NumberT, shown: Callable[[NumberT], str] = str) -> NumberT:
    if not low <= value <= high:
        raise ValueError(f"must be within {shown(low)} and {shown(high)}")
    return value


def size(low: int, high: int) -> Type:
    """Return the type of sizes: a number with K, M or G (powers of 1024), within [low, high]."""

    def parse(text: str) -> int:
        unit = text[-1:].upper()
        digits = text[:-1] if unit in _UNITS and unit else text
        if not _is_number(digits):
            raise ValueError("must be a whole number of bytes, perhaps with K, M or G behind it")
        return _within(int(digits) * _UNITS.get(unit, 1), low, high, shown=_with_unit)

    return Type(parse, _with_unit)


def number(low: int, high: int) -> Type:
    """Return the type of whole numbers within [low, high]."""

    def parse(text: str) -> int:
        if not _is_number(text):
            raise ValueError("must be a whole number")
        return _within(int(text), low, high)

    return Type(parse)


def or_auto(kind: Type) -> Type:
    """Return a type that also takes `auto`, which stands for None."""

    def parse(text: str) -> Any:
        try:
            return None if text == "auto" else kind.parse(text)
        except ValueError as exc:
            raise ValueError(f"{exc}, or auto") from None

    return Type(parse, lambda value: "auto" if value is None else kind.written(value))


def seconds(low: float, high: float) -> Type:
    """Return the type of seconds within [low, high]."""

    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            raise ValueError("must be a number of seconds") from None
        return _within(value, low, high, shown="{:g}".format)

    return Type(parse, "{:g}".format)


def choice(*words: str) -> Type:
    """Return the type that takes one of a few words."""

    def parse(text: str) -> str:
        if text not in words:
            raise ValueError(f"must be one of {', '.join(words)}")
        return text

    return Type(parse)


def _not_empty(text: str) -> str:
    if not text:
        raise ValueError("must not be empty")
    return text


def remote_path(text: str) -> bytes:
    """Parse a directory on the vehicle."""
    return normalise(_not_empty(text).encode("utf-8", "surrogateescape"))


def _octal(text: str) -> int:
    if not re.fullmatch("[0-7]{1,4}", text) or int(text, 8) > 0o777:
        raise ValueError("must be an octal number of at most 777, as 022")
    return int(text, 8)


LOCAL_FILE = Type(_not_empty, is_file=True)
_MASK = Type(_octal)
_ID = number(0, 2**32 - 2)


# -- the table ------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Option:
    """A row of the table. default: in words. type: None for an option without a value.

    words: the words of an option without a value, and the field's value for each. many: the option may be
    given several times, and all values count. of_kernel: the option has no effect without a mount.
    """

    field: str
    help: str
    default: str
    type: Type | None = None
    words: tuple[tuple[str, bool], ...] = ()
    many: bool = False
    of_kernel: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        """The option's spellings: `ro` and `rw`, or `chunk=`."""
        return (f"{self.field}=",) if self.type is not None else tuple(word for word, _ in self.words)


def valued(default: Any, kind: Type, help: str, *, shown: str = "", **more: bool) -> Any:
    """Return the field of an option with a value. shown: the default in words, if `kind` cannot write it;
    more: as in Option."""
    row = {"type": kind, "help": help, "default": shown or kind.written(default), **more}
    return field(default=default, metadata=row)


def switch(words: Mapping[str, bool], help: str, **more: bool) -> Any:
    """Return the field of an option without a value, whose default is False. more: as in Option."""
    shown = next((word for word, value in words.items() if not value), "off")
    row = {"words": tuple(words.items()), "help": help, "default": shown, **more}
    return field(default=False, metadata=row)


@dataclass(frozen=True, slots=True)
class Options:
    """The way to reach a vehicle and to treat its files.

    Seconds, bytes, bytes per second and permission bits; None = determined at run time, or unset. SOURCE sets
    root; baud overrides that of SOURCE. kernel_words: words of `-o` for libfuse. local: files of
    `cache.localfiles` never reach the vehicle.
    """

    read_only: bool = switch({"ro": True, "rw": False}, "change nothing (ro), or allow changes (rw)")
    allow_other: bool = switch(
        {"allow_other": True},
        "let other users in; needs user_allow_other in /etc/fuse.conf, unless root mounts",
        of_kernel=True,
    )
    uid: int | None = valued(
        None, _ID, "owner of the files; the kernel checks permissions", shown="you", of_kernel=True
    )
    gid: int | None = valued(None, _ID, "group of the files", shown="your group", of_kernel=True)
    umask: int | None = valued(
        None, _MASK, "permissions to take away, in octal", shown="your umask", of_kernel=True
    )
    fmask: int | None = valued(
        None, _MASK, "permissions to take away from files", shown="umask=", of_kernel=True
    )
    dmask: int | None = valued(
        None, _MASK, "permissions to take away from directories", shown="umask=", of_kernel=True
    )
    all: bool = switch(
        {"all": True},
        "mount each vehicle that sends heartbeats, below the mountpoint by its system id",
        of_kernel=True,
    )
    kernel_words: tuple[str, ...] = ()
    root: bytes = ROOT
    baud: int | None = None
    target_system: int = valued(0, number(0, 255), "vehicle, by system id; 0: the first autopilot heard")
    target_component: int = valued(0, number(0, 255), "component of the vehicle, by id; 0: the first heard")
    source_system: int = valued(254, number(1, 255), "system id of mavftpfs on the link")
    forward: tuple[str, ...] = valued(
        (),
        Type(_not_empty),
        "endpoint to exchange all frames with, written like SOURCE; may be repeated",
        shown="none",
        many=True,
    )
    signing_key: str | None = valued(
        None,
        LOCAL_FILE,
        "file with the MAVLink 2 signing key, mode 0600: 32 bytes, 64 hex digits or a passphrase",
        shown="none",
    )
    connect_timeout: float = valued(30.0, seconds(1, 3600), "seconds to wait for a heartbeat and a listing")
    op_deadline: float = valued(30.0, seconds(1, 3600), "seconds without progress after which a call fails")
    bwlimit: int | None = valued(
        None,
        size(100, _SIZE_MAX),
        "bytes per second of the link to use for files, about; requests and replies together",
        shown="none",
    )
    read_mode: Literal["window", "burst"] = valued(
        "window",
        choice("window", "burst"),
        "window: many requests in flight; burst: the vehicle sends by itself",
    )
    chunk: int | None = valued(
        None,
        or_auto(number(16, 239)),
        "bytes of a file in a packet, 16 to 239; auto: 239, or 64 where full packets do not pass",
    )
    dir_timeout: float | None = valued(
        None,
        seconds(0, _DAY),
        "seconds to believe a listing; 0: ask the vehicle each time",
        shown="20, longer if the listing was slow",
    )
    cache_size: int = valued(64 << 20, size(1 << 20, _SIZE_MAX), "memory for file data")
    when_armed: Literal["ro", "ok"] = valued(
        "ro", choice("ro", "ok"), "ro: an armed vehicle is read-only; ok: write in flight, too"
    )
    verify_max: int = valued(
        4 << 20, size(0, _SIZE_MAX), "size up to which written files are compared by CRC32, not only by size"
    )
    inplace: bool = switch(
        {"inplace": True},
        "empty and rewrite files where the card cannot rename; an interruption leaves a part of the new file",
    )
    local: bool = True
    tlog: str | None = valued(None, LOCAL_FILE, "file for a raw MAVLink log of the link", shown="none")
    gone: tuple[str, ...] = field(default=(), compare=False)
    """A line for people about each removed word of 0.2 that was given."""


def parsed_by(parse: Parser, name: str, text: str) -> Any:
    """Return the value of an option.

    Raises:
        UsageError: a bad value; the message names the option.
    """
    try:
        return parse(text)
    except (ValueError, MavftpfsError) as exc:
        raise UsageError(f"option {name}={text}: {exc}") from exc


class Table:
    """Rows, by the words that name them.

    Attributes:
        values: name -> the row of an option with a value.
        words: word without a value -> the field that it sets, and to what.
    """

    def __init__(self, rows: Iterable[Option]) -> None:
        self.rows = tuple(rows)
        self.values = {row.field: row for row in self.rows if row.type is not None}
        self.words = {word: (row.field, value) for row in self.rows for word, value in row.words}

    @property
    def local_files(self) -> list[str]:
        """The options whose values are paths on this computer."""
        return [name for name, row in self.values.items() if row.type is not None and row.type.is_file]

    def parsed(self, name: str, text: str, earlier: Mapping[str, Any]) -> Any:
        """Return the value of an option, appended to its earlier values if all of them count.

        Raises:
            UsageError: a bad value; the message names the option.
        """
        row = self.values[name]
        assert row.type is not None
        value = parsed_by(row.type.parse, name, text)
        return tuple(dict.fromkeys((*earlier.get(name, ()), value))) if row.many else value


TABLE = Table(Option(one.name, **one.metadata) for one in fields(Options) if one.metadata)
LIBRARY = Table(row for row in TABLE.rows if not row.of_kernel)
"""The rows that are keywords of the library."""
