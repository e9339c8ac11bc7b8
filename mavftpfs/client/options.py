"""Mount options: one table, parsed into a frozen value. Layer: client; pure.

`-o` text may come from a person, /etc/fstab or mount(8), which adds words of its own (`rw,dev,suid`).
Words that the kernel understands go to FUSE, words that only mount(8) and systemd need are ignored,
and everything else that is not in the table is refused by name.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, TypeVar

from mavftpfs.cache.options import DEFAULT_LOCAL
from mavftpfs.shared.errors import MavftpfsError, UsageError
from mavftpfs.shared.model import ROOT, normalise

SUBTYPE = "mavftpfs"
"""The mount's type is fuse.mavftpfs: the same word that fstab has."""

KERNEL_WORDS = frozenset(
    {"dev", "nodev", "suid", "nosuid", "exec", "noexec", "atime", "noatime", "sync", "async", "dirsync"}
)
"""VFS words that libfuse takes."""

_NO_MEANING = {
    *("defaults", "diratime", "nodiratime", "relatime", "norelatime", "strictatime", "nostrictatime"),
    *("lazytime", "nolazytime", "nodirsync"),
}
"""VFS words for access times, which are not kept; libfuse does not know them."""

_FOR_OTHERS = {
    *("auto", "noauto", "user", "nouser", "users", "nousers", "owner", "noowner", "group", "nogroup"),
    *("_netdev", "nofail"),
}
"""Words for mount(8) and systemd."""

IGNORED_WORDS = frozenset(_NO_MEANING | _FOR_OTHERS)
IGNORED_PREFIXES = ("x-", "X-", "comment=", "user=")

_UNITS = {"": 1, "K": 1 << 10, "M": 1 << 20, "G": 1 << 30}
_DAY = 86400.0


@dataclass(frozen=True, slots=True)
class MountOptions:
    """What `-o` says. Seconds, octal bits; None = not given.

    passed_on: values for the session and the caches, by the names that they have there, where their defaults
    are, too.
    """

    read_only: bool = False
    allow_other: bool = False
    auto_unmount: bool = False
    uid: int | None = None
    gid: int | None = None
    umask: int | None = None
    fmask: int | None = None
    dmask: int | None = None
    fsname: str | None = None
    root: bytes = ROOT
    baud: int | None = None
    signing_key: str | None = None
    cache_dir: str | None = None
    op_deadline: float = 30.0
    connect_timeout: float = 30.0
    when_armed: str = "ro"
    log_file: str | None = None
    trace: str | None = None
    tlog: str | None = None
    kernel_words: tuple[str, ...] = ()
    passed_on: Mapping[str, Any] = field(default_factory=dict)

    def file_mode(self, default_umask: int) -> int:
        """Return the permission bits of files; write bits go where the mount is read-only."""
        return self._bits(0o666, self.fmask, default_umask)

    def directory_mode(self, default_umask: int) -> int:
        """Return the permission bits of directories."""
        return self._bits(0o777, self.dmask, default_umask)

    def _bits(self, full: int, own_mask: int | None, default_umask: int) -> int:
        mask = own_mask if own_mask is not None else self.umask
        bits = full & ~(default_umask if mask is None else mask)
        return bits & ~0o222 if self.read_only else bits


Parser = Callable[[str], Any]
"""Parses the text of a value; raises ValueError, which says what it should have been."""


def _or_auto(parse: Parser) -> Parser:
    """Return a parser that also takes `auto`, and says so."""

    def parse_or_auto(text: str) -> Any:
        try:
            return None if text == "auto" else parse(text)
        except ValueError as exc:
            raise ValueError(f"{exc}, or auto") from None

    return parse_or_auto


def size(low: int, high: int, *, auto: bool = False) -> Parser:
    """Return a parser of sizes: a number with K, M or G (powers of 1024), within [low, high]."""

    def parse(text: str) -> int:
        unit = text[-1:].upper()
        digits = text[:-1] if unit in _UNITS and unit else text
        if not _is_number(digits):
            raise ValueError("must be a whole number of bytes, perhaps with K, M or G behind it")
        return _within(int(digits) * _UNITS.get(unit, 1), low, high, shown=_with_unit)

    return _or_auto(parse) if auto else parse


def number(low: int, high: int, *, auto: bool = False) -> Parser:
    """Return a parser of whole numbers within [low, high]."""

    def parse(text: str) -> int:
        if not _is_number(text):
            raise ValueError("must be a whole number")
        return _within(int(text), low, high)

    return _or_auto(parse) if auto else parse


def seconds(low: float, high: float) -> Parser:
    """Return a parser of seconds within [low, high]."""

    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            raise ValueError("must be a number of seconds") from None
        return _within(value, low, high, shown="{:g}".format)

    return parse


def choice(*words: str) -> Parser:
    """Return a parser that takes one of `words`."""

    def parse(text: str) -> str:
        if text not in words:
            raise ValueError(f"must be one of {', '.join(words)}")
        return text

    return parse


def mask(text: str) -> int:
    """Parse an octal permission mask."""
    if not re.fullmatch("[0-7]{1,4}", text) or int(text, 8) > 0o777:
        raise ValueError("must be an octal number of at most 777, as 022")
    return int(text, 8)


def text_value(text: str) -> str:
    """Take any text but none."""
    if not text:
        raise ValueError("must not be empty")
    return text


def remote_path(text: str) -> bytes:
    """Parse a directory on the vehicle."""
    return normalise(text_value(text).encode("utf-8", "surrogateescape"))


def patterns(text: str) -> tuple[str, ...]:
    """Parse colon-separated name patterns: a bare list replaces the defaults, `+` before it adds to them,
    and an empty one switches the feature off."""
    added = text.startswith("+")
    given = tuple(part for part in text.removeprefix("+").split(":") if part)
    return (*DEFAULT_LOCAL, *given) if added else given


_SIZE_MAX = 1 << 40


class Value(NamedTuple):
    """An option with a value: how it is parsed, and what help says of it, with the default."""

    parse: Parser
    help: str


VALUES: dict[str, Value] = {
    "uid": Value(number(0, 2**32 - 2), "whose the files are: you"),
    "gid": Value(number(0, 2**32 - 2), "whose group's: yours"),
    "umask": Value(mask, "octal; your umask"),
    "fmask": Value(mask, "umask of files only"),
    "dmask": Value(mask, "umask of directories only"),
    "fsname": Value(text_value, "name in the table of mounts: SOURCE"),
    "root": Value(remote_path, "mount this directory of the vehicle: /"),
    "target_system": Value(number(0, 255), "which vehicle; 0: the first autopilot heard"),
    "target_component": Value(number(0, 255), "which part of it; 0: the first heard"),
    "source_system": Value(number(1, 255), "who we are on the link: 254"),
    "source_component": Value(number(1, 255), "and which part: 191"),
    "heartbeat": Value(choice("onboard", "gcs", "none"), "what we say we are: onboard, gcs or none"),
    "baud": Value(number(300, 12_000_000), "of a serial line: 57600"),
    "signing_key": Value(text_value, "file with the key of MAVLink 2 signing, mode 0600"),
    "dir_timeout": Value(seconds(0, _DAY), "seconds that a listing is kept: 20, longer if it is slow"),
    "attr_timeout": Value(seconds(0, _DAY), "seconds that the kernel keeps attributes: 1"),
    "negative_timeout": Value(seconds(0, _DAY), "seconds that it keeps absent names: 2"),
    "cache_size": Value(size(1 << 20, _SIZE_MAX), "memory for file data: 64M"),
    "cache_dir": Value(text_value, "keep what was read for the next mount there"),
    "dirty_max": Value(size(1 << 16, _SIZE_MAX, auto=True), "memory for what is not on the card yet: auto"),
    "spool_max": Value(size(0, _SIZE_MAX), "local disk for what is not on the card yet: 1G"),
    "rmw_max": Value(size(0, _SIZE_MAX, auto=True), "largest file sent again whole for a changed part: auto"),
    "op_deadline": Value(seconds(1, 3600), "seconds without progress until an error: 30"),
    "connect_timeout": Value(seconds(1, 3600), "seconds for the first heartbeat and listing: 30"),
    "read_mode": Value(choice("window", "burst"), "window or burst"),
    "chunk": Value(number(16, 239, auto=True), "bytes of a file in a packet, 16 to 239: auto"),
    "window": Value(number(1, 256, auto=True), "requests in flight at most: auto"),
    "bwlimit": Value(size(100, _SIZE_MAX), "bytes per second that we may cause on the link"),
    "verify": Value(
        choice("auto", "size", "crc", "none"), "written files: auto (size, and CRC32), size, crc, none"
    ),
    "verify_max": Value(size(0, _SIZE_MAX), "largest file whose CRC32 is asked for by auto: 4M"),
    "when_armed": Value(choice("ro", "ok"), "an armed vehicle is read-only: ro, or ok"),
    "local": Value(patterns, "names that never reach the card; +PATTERN adds to them"),
    "log_file": Value(text_value, "log there, not to syslog"),
    "trace": Value(text_value, "every request and reply as a line of JSON there"),
    "tlog": Value(text_value, "raw MAVLink log there"),
}


class Flag(NamedTuple):
    """A word without a value: the field that it sets, to what, and what help says of it."""

    field: str
    becomes: bool
    help: str


FLAGS: dict[str, Flag] = {
    "ro": Flag("read_only", True, "nothing is changed"),
    "rw": Flag("read_only", False, "the default"),
    "allow_other": Flag("allow_other", True, "other users may see it (permissions apply)"),
    "auto_unmount": Flag("auto_unmount", True, "unmount when this process dies"),
    "force": Flag("force", True, "change files that are seen to grow, too"),
    "inplace": Flag("inplace", True, "replace files in place where the card cannot rename"),
    "default_permissions": Flag("", True, ""),
}
"""default_permissions is always on, and not shown."""


def parse_options(texts: Iterable[str]) -> MountOptions:
    """Parse the values of all `-o`; what is said later wins.

    Raises:
        UsageError: an unknown option, a missing or bad value; the message names the option.
    """
    values: dict[str, Any] = {}
    words: list[str] = []
    for word in split_words(texts):
        _take(word, values, words)
    own = {name: values.pop(name) for name in MountOptions.__slots__ if name in values}
    return MountOptions(**own, kernel_words=tuple(words), passed_on=values)


def with_root(options: MountOptions, subtree: bytes) -> MountOptions:
    """Return the options with the `#subtree` of SOURCE as root.

    Raises:
        UsageError: root= says it too.
    """
    if subtree == ROOT:
        return options
    if options.root != ROOT:
        raise UsageError("give the remote directory either behind '#' or as root=, not both")
    return replace(options, root=subtree)


def fuse_words(options: MountOptions, source: str) -> set[str]:
    """Return the options that go to FUSE's init."""
    name = options.fsname or source
    words = {f"fsname={_escape(name)}", f"subtype={SUBTYPE}", "default_permissions", *options.kernel_words}
    words.add("ro" if options.read_only else "rw")
    if options.allow_other:
        words.add("allow_other")
    if options.auto_unmount:
        words.add("auto_unmount")
    return words


def _take(word: str, values: dict[str, Any], kernel_words: list[str]) -> None:
    name, equals, value = word.partition("=")
    if word in FLAGS:
        flag = FLAGS[word]
        if flag.field:
            values[flag.field] = flag.becomes
    elif word in KERNEL_WORDS:
        _replace_word(word, kernel_words)
    elif name in VALUES:
        values[name] = _parse(name, value, given=bool(equals))
    elif word not in IGNORED_WORDS and not word.startswith(IGNORED_PREFIXES):
        raise UsageError(_refusal(name, word))


def _refusal(name: str, word: str) -> str:
    if name in FLAGS or name in KERNEL_WORDS or name in IGNORED_WORDS:
        return f"option {name} takes no value"
    if name == "remount":
        return "option remount is not supported: unmount, and mount with the new options"
    if name == "max_read":
        return "option max_read is not supported: the FUSE binding cannot start with it"
    return f"unknown option {word!r}"


def _replace_word(word: str, words: list[str]) -> None:
    """Keep one of a word and its opposite: libfuse would apply both in the order of a set."""
    opposite = {"sync": "async", "async": "sync"}.get(
        word, word[2:] if word.startswith("no") else "no" + word
    )
    for stale in (word, opposite):
        if stale in words:
            words.remove(stale)
    words.append(word)


def _parse(name: str, value: str, *, given: bool) -> Any:
    if not given:
        raise UsageError(f"option {name} needs a value ({name}=...)")
    try:
        return VALUES[name].parse(value)
    except (ValueError, MavftpfsError) as exc:
        raise UsageError(f"option {name}={value}: {exc}") from exc


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


def _escape(name: str) -> str:
    """Make a name fit for one ASCII option of a comma-separated list."""
    ascii_name = name.encode("ascii", "backslashreplace").decode("ascii").replace("\n", " ")
    return ascii_name.replace("\\", "\\\\").replace(",", "\\,")


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


def option_help() -> dict[str, str]:
    """Return each option as it is written in help -> what it does, with its default."""
    flags = {name: flag.help for name, flag in FLAGS.items() if flag.help}
    return flags | {f"{name}=": value.help for name, value in VALUES.items()}
