"""A mount's options: the client's, and what only the kernel's side needs. Layer: mount; pure.

`-o` text may come from a person, /etc/fstab or mount(8), which adds words of its own (`rw,dev,suid`).
Words that the kernel understands go to FUSE, words that only mount(8) and systemd need are ignored,
and everything else that is not in a table is refused by name. The commands without a mount take the same
words, so that a line of /etc/fstab can be given to them.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from mavftpfs.client import options as client
from mavftpfs.client.mountpoint import SUBTYPE
from mavftpfs.client.options import Flag, Flags, Options, Value, Values, collected, number, take_gone
from mavftpfs.shared.errors import UsageError

KERNEL_WORDS = frozenset({"dev", "nodev", "suid", "nosuid", "exec", "noexec", "sync", "async", "dirsync"})
"""VFS words that libfuse takes."""

_NO_MEANING = {
    *(
        "defaults",
        "atime",
        "noatime",
        "diratime",
        "nodiratime",
        "relatime",
        "norelatime",
        "strictatime",
        "nostrictatime",
    ),
    *("lazytime", "nolazytime", "nodirsync"),
}
"""VFS words that change nothing: most are for access times, which no vehicle keeps. libfuse knows only some
of them, and fewer with each version (3.15 refuses `atime`)."""

_FOR_OTHERS = {
    *("auto", "noauto", "user", "nouser", "users", "nousers", "owner", "noowner", "group", "nogroup"),
    *("_netdev", "nofail"),
}
"""Words for mount(8) and systemd."""

IGNORED_WORDS = frozenset(_NO_MEANING | _FOR_OTHERS)
IGNORED_PREFIXES = ("x-", "X-", "comment=", "user=")


@dataclass(frozen=True, slots=True)
class MountOptions:
    """The options of `-o`. Octal bits; None = not given. client: options that do not concern the kernel. all:
    a mount for each vehicle that is heard, below the mountpoint."""

    client: Options = field(default_factory=Options)
    allow_other: bool = False
    uid: int | None = None
    gid: int | None = None
    umask: int | None = None
    fmask: int | None = None
    dmask: int | None = None
    all: bool = False
    kernel_words: tuple[str, ...] = ()

    def file_mode(self, default_umask: int) -> int:
        """Return the permission bits of files; write bits go where the mount is read-only."""
        return self._bits(0o666, self.fmask, default_umask)

    def directory_mode(self, default_umask: int) -> int:
        """Return the permission bits of directories."""
        return self._bits(0o777, self.dmask, default_umask)

    def _bits(self, full: int, own_mask: int | None, default_umask: int) -> int:
        mask = own_mask if own_mask is not None else self.umask
        bits = full & ~(default_umask if mask is None else mask)
        return bits & ~0o222 if self.client.read_only else bits


def mask(text: str) -> int:
    """Parse an octal permission mask."""
    if not re.fullmatch("[0-7]{1,4}", text) or int(text, 8) > 0o777:
        raise ValueError("must be an octal number of at most 777, as 022")
    return int(text, 8)


OWN_VALUES: Values = {
    "uid": Value(number(0, 2**32 - 2), "whose the files are: you"),
    "gid": Value(number(0, 2**32 - 2), "whose group's: yours"),
    "umask": Value(mask, "octal; your umask"),
    "fmask": Value(mask, "umask of files only"),
    "dmask": Value(mask, "umask of directories only"),
}

OWN_FLAGS: Flags = {
    "allow_other": Flag("allow_other", True, "other users may see it (permissions apply)"),
    "all": Flag("all", True, "each vehicle, below the mountpoint by its system id"),
    "default_permissions": Flag("", True, ""),
}
"""default_permissions is always on, and not shown."""

VALUES: Values = {**OWN_VALUES, **client.VALUES}
LOCAL_PATHS = ("signing_key", "tlog")
"""Options whose values are paths on this computer."""

FLAGS: Flags = {**client.FLAGS, **OWN_FLAGS}


def parse_options(texts: Iterable[str]) -> MountOptions:
    """Parse the values of all `-o`; later words win.

    Raises:
        UsageError: an unknown option, a missing or bad value; the message names the option.
    """
    values: dict[str, Any] = {}
    words: list[str] = []
    for word in client.split_words(texts):
        _take(word, values, words)
    own = {name: values.pop(name) for name in MountOptions.__slots__ if name in values}
    options = MountOptions(Options(**values), kernel_words=tuple(words), **own)
    if options.all and (options.client.target_system or options.client.target_component):
        raise UsageError("option all is for each vehicle; leave out target_system= and target_component=")
    return options


def fuse_words(options: MountOptions, source: str) -> set[str]:
    """Return the options that go to FUSE's init."""
    words = {f"fsname={_escape(source)}", f"subtype={SUBTYPE}", "default_permissions", *options.kernel_words}
    words.add("ro" if options.client.read_only else "rw")
    if options.allow_other:
        words.add("allow_other")
    return words


def option_help() -> dict[str, str]:
    """Return each option as it is written in help -> what it does, with its default."""
    flags = {name: flag.help for name, flag in FLAGS.items() if flag.help}
    return flags | {f"{name}=": value.help for name, value in VALUES.items()}


def _take(word: str, values: dict[str, Any], kernel_words: list[str]) -> None:
    name, equals, value = word.partition("=")
    if word in FLAGS:
        flag = FLAGS[word]
        if flag.field:
            values[flag.field] = flag.becomes
    elif word in KERNEL_WORDS:
        _replace_word(word, kernel_words)
    elif name in VALUES:
        if not equals:
            raise UsageError(f"option {name} needs a value ({name}=...)")
        values[name] = collected(VALUES, values, name, value)
    elif word in IGNORED_WORDS or word.startswith(IGNORED_PREFIXES):
        return
    elif not take_gone(values, name, value):
        raise UsageError(_refusal(name, word))


def _refusal(name: str, word: str) -> str:
    if name in FLAGS or name in KERNEL_WORDS or name in IGNORED_WORDS:
        return f"option {name} takes no value"
    if name == "remount":
        return "option remount is not supported: unmount, and mount with the new options"
    if name == "max_read":
        return "option max_read is not supported: the FUSE binding cannot start with it"
    near = difflib.get_close_matches(name, [*VALUES, *FLAGS], 1)
    return f"unknown option {word!r}" + (f"; did you mean {near[0]}?" if near else "")


def _replace_word(word: str, words: list[str]) -> None:
    """Keep one of a word and its opposite: libfuse would apply both in the order of a set."""
    opposite = {"sync": "async", "async": "sync"}.get(
        word, word[2:] if word.startswith("no") else "no" + word
    )
    for stale in (word, opposite):
        if stale in words:
            words.remove(stale)
    words.append(word)


def _escape(name: str) -> str:
    """Make a name fit for one ASCII option of a comma-separated list."""
    ascii_name = name.encode("ascii", "backslashreplace").decode("ascii").replace("\n", " ")
    return ascii_name.replace("\\", "\\\\").replace(",", "\\,")
