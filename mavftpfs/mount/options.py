"""The words of `-o`: options, and words for the kernel, mount(8) and systemd. Layer: mount; pure.

`-o` text may come from a person, /etc/fstab or mount(8), which adds words of its own (`rw,dev,suid`).
Words that the kernel understands go to FUSE, words that only mount(8) and systemd need are ignored, and any
other unknown word is an error that names it. The commands without a mount take the same words, so that they
accept a line of /etc/fstab.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Any

from mavftpfs.client.mountpoint import SUBTYPE
from mavftpfs.client.options import split_words, take_gone
from mavftpfs.shared.errors import UsageError
from mavftpfs.shared.options import TABLE, Options

KERNEL_WORDS = frozenset({"dev", "nodev", "suid", "nosuid", "exec", "noexec", "sync", "async", "dirsync"})
"""VFS words that libfuse takes."""

_ALWAYS_ON = "default_permissions"
"""No server checks permissions, so the kernel always does."""

IGNORED_WORDS = frozenset(
    (
        *("defaults", "atime", "noatime", "diratime", "nodiratime", "relatime", "norelatime", "strictatime"),
        *(
            "nostrictatime",
            "lazytime",
            "nolazytime",
            "nodirsync",
            "auto",
            "noauto",
            "user",
            "nouser",
            "users",
        ),
        *("nousers", "owner", "noowner", "group", "nogroup", "_netdev", "nofail", _ALWAYS_ON),
    )
)
"""Words for mount(8) and systemd, and VFS words that change nothing: most are about access times, which no
vehicle keeps. libfuse knows only some of them, and fewer with each version (3.15 refuses `atime`)."""
IGNORED_PREFIXES = ("x-", "X-", "comment=", "user=")


def parse_options(texts: Iterable[str]) -> Options:
    """Parse the values of all `-o`; later words win.

    Raises:
        UsageError: an unknown option, a missing or bad value; the message names the option.
    """
    values: dict[str, Any] = {}
    words: list[str] = []
    for word in split_words(texts):
        _take(word, values, words)
    options = Options(**values, kernel_words=tuple(words))
    if options.all and (options.target_system or options.target_component):
        raise UsageError("option all is for each vehicle; leave out target_system= and target_component=")
    return options


def permissions(options: Options, full: int, own_mask: int | None, default_umask: int) -> int:
    """Return the permission bits of files, or of directories: those of `full` without those of a mask.

    own_mask: the mask of that kind, which takes precedence over umask=. A read-only mount has no write bits.
    """
    masks = (own_mask, options.umask, default_umask)
    bits = full & ~next(mask for mask in masks if mask is not None)
    return bits & ~0o222 if options.read_only else bits


def fuse_words(options: Options, source: str) -> set[str]:
    """Return the options for FUSE's init."""
    words = {f"fsname={_escape(source)}", f"subtype={SUBTYPE}", _ALWAYS_ON, *options.kernel_words}
    words.add("ro" if options.read_only else "rw")
    if options.allow_other:
        words.add("allow_other")
    return words


def option_help() -> dict[str, str]:
    """Return each option's spelling -> its help, with its default."""
    return {", ".join(row.names): f"{row.help} (default: {row.default})" for row in TABLE.rows}


def _take(word: str, values: dict[str, Any], kernel_words: list[str]) -> None:
    name, equals, value = word.partition("=")
    if word in TABLE.words:
        place, becomes = TABLE.words[word]
        values[place] = becomes
    elif word in KERNEL_WORDS:
        _replace_word(word, kernel_words)
    elif name in TABLE.values:
        if not equals:
            raise UsageError(f"option {name} needs a value ({name}=...)")
        values[name] = TABLE.parsed(name, value, values)
    elif word in IGNORED_WORDS or word.startswith(IGNORED_PREFIXES):
        return
    elif not take_gone(values, name, value):
        raise UsageError(_refusal(name, word))


def _refusal(name: str, word: str) -> str:
    if name in TABLE.words or name in KERNEL_WORDS or name in IGNORED_WORDS:
        return f"option {name} takes no value"
    if name == "remount":
        return "option remount is not supported: unmount, and mount with the new options"
    if name == "max_read":
        return "option max_read is not supported: the FUSE binding cannot start with it"
    near = difflib.get_close_matches(name, [*TABLE.values, *TABLE.words], 1)
    return f"unknown option {word!r}" + (f"; did you mean {near[0]}?" if near else "")


def _replace_word(word: str, words: list[str]) -> None:
    """Keep one of a word and its opposite, because libfuse would apply both in the order of a set."""
    opposite = {"sync": "async", "async": "sync"}.get(
        word, word[2:] if word.startswith("no") else "no" + word
    )
    for stale in (word, opposite):
        if stale in words:
            words.remove(stale)
    words.append(word)


def _escape(name: str) -> str:
    """Escape a name for one ASCII option of a comma-separated list."""
    ascii_name = name.encode("ascii", "backslashreplace").decode("ascii").replace("\n", " ")
    return ascii_name.replace("\\", "\\\\").replace(",", "\\,")
