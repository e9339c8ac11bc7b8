"""The options for a vehicle's files: one table, one frozen record. Layer: client; pure.

A mount, the commands and the library share it. Both `-o` text and the library's keywords are parsed by it, so
both take and refuse the same names and values. Options of the kernel's side of a mount are in
`mount.options`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple, TypeVar

from mavftpfs.link.uri import LinkKind, LinkSpec, parse_endpoint
from mavftpfs.shared.errors import MavftpfsError, UsageError
from mavftpfs.shared.model import ROOT, normalise

_UNITS = {"": 1, "K": 1 << 10, "M": 1 << 20, "G": 1 << 30}
_DAY = 86400.0


@dataclass(frozen=True, slots=True)
class Options:
    """How to reach a vehicle and how to treat its files.

    Seconds, bytes and bytes per second; None = found out, or not wanted. SOURCE sets root; baud overrides
    that of SOURCE. `session.connection.ConnectOptions` explains the session's values, and
    `cache.options.CacheOptions` those of the caches.
    """

    read_only: bool = False
    root: bytes = ROOT
    baud: int | None = None
    target_system: int = 0
    target_component: int = 0
    source_system: int = 254
    signing_key: str | None = None
    op_deadline: float = 30.0
    connect_timeout: float = 30.0
    read_mode: Literal["window", "burst"] = "window"
    chunk: int | None = None
    bwlimit: int | None = None
    dir_timeout: float | None = None
    cache_size: int = 64 << 20
    verify_max: int = 4 << 20
    when_armed: Literal["ro", "ok"] = "ro"
    inplace: bool = False
    local: bool = True
    tlog: str | None = None
    forward: tuple[str, ...] = ()
    gone: tuple[str, ...] = field(default=(), compare=False)
    """A line for people about each word of 0.2 that was given and is gone."""


Parser = Callable[[str], Any]
"""Parses the text of a value; raises ValueError, which says what it should have been."""


def size(low: int, high: int) -> Parser:
    """Return a parser of sizes: a number with K, M or G (powers of 1024), within [low, high]."""

    def parse(text: str) -> int:
        unit = text[-1:].upper()
        digits = text[:-1] if unit in _UNITS and unit else text
        if not _is_number(digits):
            raise ValueError("must be a whole number of bytes, perhaps with K, M or G behind it")
        return _within(int(digits) * _UNITS.get(unit, 1), low, high, shown=_with_unit)

    return parse


def number(low: int, high: int) -> Parser:
    """Return a parser of whole numbers within [low, high]."""

    def parse(text: str) -> int:
        if not _is_number(text):
            raise ValueError("must be a whole number")
        return _within(int(text), low, high)

    return parse


def or_auto(parse: Parser) -> Parser:
    """Return a parser that also takes `auto`, and says so."""

    def parse_or_auto(text: str) -> Any:
        try:
            return None if text == "auto" else parse(text)
        except ValueError as exc:
            raise ValueError(f"{exc}, or auto") from None

    return parse_or_auto


def seconds(low: float, high: float) -> Parser:
    """Return a parser of seconds within [low, high]."""

    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            raise ValueError("must be a number of seconds") from None
        return _within(value, low, high, shown="{:g}".format)

    return parse


class Choice:
    """A parser that takes one of a few words."""

    def __init__(self, *words: str) -> None:
        self.words = words

    def __call__(self, text: str) -> str:
        """See Parser."""
        if text not in self.words:
            raise ValueError(f"must be one of {', '.join(self.words)}")
        return text


def text_value(text: str) -> str:
    """Take any text that is not empty."""
    if not text:
        raise ValueError("must not be empty")
    return text


def remote_path(text: str) -> bytes:
    """Parse a directory on the vehicle."""
    return normalise(text_value(text).encode("utf-8", "surrogateescape"))


def endpoint(text: str) -> str:
    """Parse where frames are forwarded to; return it in one spelling."""
    return parse_endpoint(text_value(text)).description


_SIZE_MAX = 1 << 40


class Value(NamedTuple):
    """An option with a value: its parser, and its help with the default. many: it may be given several times,
    and all count."""

    parse: Parser
    help: str
    many: bool = False


Values = Mapping[str, Value]

VALUES: Values = {
    "target_system": Value(number(0, 255), "which vehicle; 0: the first autopilot heard"),
    "target_component": Value(number(0, 255), "which part of it; 0: the first heard"),
    "source_system": Value(number(1, 255), "system id of mavftpfs on the link: 254"),
    "signing_key": Value(text_value, "file with the key of MAVLink 2 signing, mode 0600"),
    "dir_timeout": Value(seconds(0, _DAY), "seconds that a listing is kept: 20, longer if it is slow"),
    "cache_size": Value(size(1 << 20, _SIZE_MAX), "memory for file data: 64M"),
    "op_deadline": Value(seconds(1, 3600), "seconds without progress until an error: 30"),
    "connect_timeout": Value(seconds(1, 3600), "seconds for the first heartbeat and listing: 30"),
    "read_mode": Value(Choice("window", "burst"), "window or burst"),
    "chunk": Value(or_auto(number(16, 239)), "bytes of a file in a packet, 16 to 239: auto"),
    "bwlimit": Value(size(100, _SIZE_MAX), "use about so many bytes per second of the link"),
    "verify_max": Value(size(0, _SIZE_MAX), "largest written file whose CRC32 is asked for: 4M"),
    "when_armed": Value(Choice("ro", "ok"), "an armed vehicle is read-only: ro, or ok"),
    "tlog": Value(text_value, "raw MAVLink log there"),
    "forward": Value(endpoint, "pass all frames on to there and back; several count", many=True),
}


class Flag(NamedTuple):
    """A word without a value: the field that it sets, the field's value, and its help."""

    field: str
    becomes: bool
    help: str


Flags = Mapping[str, Flag]

FLAGS: Flags = {
    "ro": Flag("read_only", True, "nothing is changed"),
    "rw": Flag("read_only", False, "the default"),
    "inplace": Flag("inplace", True, "replace files in place where the card cannot rename"),
}


class Gone(NamedTuple):
    """An option of version 0.2 that is gone. now: what holds instead, or what to write.

    becomes: the field of Options that its value still sets, by `parse`. refused: the option is an error.
    """

    now: str
    becomes: str = ""
    parse: Parser = str
    refused: bool = False


GONE: Mapping[str, Gone] = {
    "auto_unmount": Gone("`mavftpfs umount` clears the mountpoint of a mount that was killed"),
    "fsname": Gone("the table of mounts shows SOURCE"),
    "log_file": Gone("the log is in the journal or syslog, and with -f on the terminal"),
    "dirty_max": Gone("what waits for the card lies on the local disk"),
    "spool_max": Gone("up to 1 GB waits on the local disk for the card"),
    "cache_dir": Gone("a mount reads again; `mavftpfs sync` keeps copies of logs"),
    "attr_timeout": Gone("dir_timeout= limits this, too; with 0 the kernel asks each time"),
    "negative_timeout": Gone("dir_timeout= limits this, too; with 0 the kernel asks each time"),
    "source_component": Gone("mavftpfs is component 191"),
    "heartbeat=onboard": Gone("that is what mavftpfs says it is"),
    "heartbeat": Gone(
        "mavftpfs always says that it is an onboard computer, because a ground station's heartbeat would "
        "trigger the vehicle's failsafe when it stops; leave the option out",
        refused=True,
    ),
    "window": Gone("mavftpfs finds out how many requests the link carries"),
    "trace": Gone("-d prints every request and reply, and tlog=FILE records the link"),
    "rmw_max": Gone("a change that needs more than two minutes of the link is refused (EFBIG)"),
    "local": Gone("the list of names that stay in memory is fixed; see the guide, Writing"),
    "force": Gone(
        "a file that the vehicle is writing is never changed (EBUSY); leave the word out", refused=True
    ),
    "root": Gone("write SOURCE#/dir", "root", remote_path),
    "baud": Gone("write /dev/ttyUSB0,57600", "baud", number(300, 12_000_000)),
    "verify=auto": Gone("that is how written files are checked"),
    "verify=size": Gone("write verify_max=0", "verify_max", lambda text: 0),
    "verify=none": Gone("the size is always compared; write verify_max=0", "verify_max", lambda text: 0),
    "verify=crc": Gone(
        "write verify_max=1024G; a CRC32 that the vehicle does not answer is no error then, but logged",
        refused=True,
    ),
}
"""A line of /etc/fstab or a unit of 0.2 goes on to mount: harmless options are ignored or translated, and the
log names them. Only what changed a promise is an error. A key may have a value. Drop all this after 0.3."""


_NO_BAUD = "option baud is gone, and means nothing here: SOURCE is no serial port"


def take_gone(values: dict[str, Any], name: str, text: str) -> bool:
    """Return whether an option is gone; if so, note a line about it in `values`.

    Raises:
        UsageError: what it asked for cannot be had any more.
    """
    gone = GONE.get(f"{name}={text}") or GONE.get(name)
    if gone is None:
        return False
    if gone.refused:
        raise UsageError(f"option {name} is gone: {gone.now}")
    if gone.becomes:
        values[gone.becomes] = parsed(gone.parse, name, text)
    values["gone"] = (*values.get("gone", ()), _gone_line(name, gone))
    return True


def _gone_line(name: str, gone: Gone) -> str:
    how = "is still understood" if gone.becomes else "is ignored"
    return f"option {name} is gone, and {how}: {gone.now}"


def options_of(keywords: Mapping[str, object]) -> Options:
    """Return the options that keywords name as `-o` does: `ro=True, target_system=2, cache_size="1G"`.

    None as a value is as if it were not given.

    Raises:
        UsageError: an unknown name, or a bad value; the message names it.
    """
    values: dict[str, Any] = {}
    for name, value in keywords.items():
        if value is None or (value is False and name in GONE):
            continue
        if name in FLAGS:
            if not isinstance(value, bool):
                raise UsageError(f"option {name} is True or False, not {value!r}")
            values[FLAGS[name].field] = FLAGS[name].becomes is value
        elif name in VALUES and VALUES[name].many and isinstance(value, list | tuple):
            values[name] = tuple(parsed(VALUES[name].parse, name, _as_text(name, one)) for one in value)
        elif name in VALUES:
            values[name] = collected(VALUES, values, name, _as_text(name, value))
        elif not take_gone(values, name, "" if value is True else _as_text(name, value)):
            raise UsageError(f"unknown option {name!r}")
    return Options(**values)


def _as_text(name: str, value: object) -> str:
    """Return a keyword's value as `-o` has it."""
    path = getattr(value, "__fspath__", None)
    text = value if path is None else path()
    if isinstance(text, bytes):
        text = text.decode("utf-8", "surrogateescape")
    if isinstance(text, bool) or not isinstance(text, str | int | float):
        raise UsageError(f"option {name} cannot be {value!r}")
    return str(text)


def at_source(spec: LinkSpec, options: Options) -> tuple[LinkSpec, Options]:
    """Return SOURCE and the options, with the `#subtree` of SOURCE as root, and baud= at a serial port.

    Raises:
        UsageError: root= is given, too.
    """
    if options.baud is not None and spec.kind is LinkKind.SERIAL:
        spec = replace(spec, baud=options.baud)
    elif options.baud is not None:
        advice = _gone_line("baud", GONE["baud"])
        gone = [_NO_BAUD if line == advice else line for line in options.gone]
        options = replace(options, gone=tuple(gone))
    if spec.subtree == ROOT:
        return spec, options
    if options.root != ROOT:
        raise UsageError("give the remote directory behind '#' only, not as root=, too")
    return spec, replace(options, root=spec.subtree)


def parsed(parse: Parser, name: str, text: str) -> Any:
    """Return the value of an option.

    Raises:
        UsageError: a bad value; the message names the option.
    """
    try:
        return parse(text)
    except (ValueError, MavftpfsError) as exc:
        raise UsageError(f"option {name}={text}: {exc}") from exc


def collected(table: Values, values: Mapping[str, Any], name: str, text: str) -> Any:
    """Return the value of an option, appended to its earlier values if all of them count.

    Raises:
        UsageError: as parsed.
    """
    value = parsed(table[name].parse, name, text)
    return tuple(dict.fromkeys((*values.get(name, ()), value))) if table[name].many else value


def split_words(texts: Iterable[str]) -> Iterator[str]:
    """Yield the words of comma-separated lists; a backslash protects a comma, as in mount(8)."""
    for text in texts:
        word = ""
        characters = iter(text)
        for character in characters:
            if character == "\\":
                word += next(characters, "\\")
            elif character == ",":
                yield from _nonempty(word)
                word = ""
            else:
                word += character
        yield from _nonempty(word)


def _nonempty(word: str) -> Iterator[str]:
    if word.strip():
        yield word.strip()


def _is_number(text: str) -> bool:
    return text.isascii() and text.isdigit()


def _with_unit(value: float) -> str:
    """Return a size as it may be written."""
    units = [(unit, factor) for unit, factor in _UNITS.items() if value and value % factor == 0]
    unit, factor = max(units, key=lambda pair: pair[1], default=("", 1))
    return f"{value // factor:.0f}{unit}"


NumberT = TypeVar("NumberT", int, float)


def _within(value: NumberT, low: NumberT, high: NumberT, shown: Callable[[NumberT], str] = str) -> NumberT:
    if not low <= value <= high:
        raise ValueError(f"must be within {shown(low)} and {shown(high)}")
    return value
