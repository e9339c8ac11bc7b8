"""The spellings of options: words of `-o`, keywords of the library, and those of 0.2. Layer: client; pure."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

from mavftpfs.link.uri import LinkKind, LinkSpec, parse_endpoint
from mavftpfs.shared.errors import UsageError
from mavftpfs.shared.model import ROOT
from mavftpfs.shared.options import LIBRARY, Options, Parser, number, parsed_by, remote_path

# -- words of 0.2 -----------------------------------------------------------------------------------


class Gone(NamedTuple):
    """A removed option of version 0.2. now: its replacement, or what to write instead.

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
    "dirty_max": Gone("pending changes wait on the local disk"),
    "spool_max": Gone("up to 1 GB of pending changes waits on the local disk"),
    "cache_dir": Gone("a mount reads files again; `mavftpfs sync` keeps copies of logs"),
    "attr_timeout": Gone("dir_timeout= limits this, too; with 0 the kernel asks each time"),
    "negative_timeout": Gone("dir_timeout= limits this, too; with 0 the kernel asks each time"),
    "source_component": Gone("mavftpfs is component 191"),
    "heartbeat=onboard": Gone("mavftpfs always is an onboard computer"),
    "heartbeat": Gone(
        "mavftpfs always says that it is an onboard computer, because a ground station's heartbeat would "
        "trigger the vehicle's failsafe when it stops; leave the option out",
        refused=True,
    ),
    "window": Gone("mavftpfs measures how many requests the link carries"),
    "trace": Gone("-d prints every request and reply, and tlog=FILE records the link"),
    "rmw_max": Gone("a change that needs more than two minutes of the link is refused (EFBIG)"),
    "local": Gone("the list of names that stay in memory is fixed; see the guide, Edit and upload"),
    "force": Gone(
        "a file that the vehicle is writing is never changed (EBUSY); leave the word out", refused=True
    ),
    "root": Gone("write SOURCE#/dir", "root", remote_path),
    "baud": Gone("write /dev/ttyUSB0,57600", "baud", number(300, 12_000_000).parse),
    "verify=auto": Gone("this is the way to verify written files"),
    "verify=size": Gone("write verify_max=0", "verify_max", lambda text: 0),
    "verify=none": Gone("the size is always compared; write verify_max=0", "verify_max", lambda text: 0),
    "verify=crc": Gone(
        "write verify_max=1024G; a CRC32 that the vehicle does not answer is logged, and no longer an error",
        refused=True,
    ),
}
"""A line of /etc/fstab or a unit of 0.2 still mounts: harmless options are ignored or translated, and the log
names them. Only an option that changed a promise is an error. A key may have a value. Drop all this after
1.0."""


_NO_BAUD = "option baud is gone, and means nothing here: SOURCE is not a serial port"


def take_gone(values: dict[str, Any], name: str, text: str) -> bool:
    """Return whether an option is a removed one; if so, note a line about it in `values`.

    Raises:
        UsageError: the option's effect no longer exists.
    """
    gone = GONE.get(f"{name}={text}") or GONE.get(name)
    if gone is None:
        return False
    if gone.refused:
        raise UsageError(f"option {name} is gone: {gone.now}")
    if gone.becomes:
        values[gone.becomes] = parsed_by(gone.parse, name, text)
    values["gone"] = (*values.get("gone", ()), _gone_line(name, gone))
    return True


def _gone_line(name: str, gone: Gone) -> str:
    how = "is still understood" if gone.becomes else "is ignored"
    return f"option {name} is gone, and {how}: {gone.now}"


# -- keywords and words ---------------------------------------------------------------------------


def options_of(keywords: Mapping[str, object]) -> Options:
    """Return the options that keywords name as `-o` does: `ro=True, target_system=2, cache_size="1G"`.

    A value of None counts as absent.

    Raises:
        UsageError: an unknown name, or a bad value; the message names it.
    """
    values: dict[str, Any] = {}
    for name, value in keywords.items():
        if value is None or (value is False and name in GONE):
            continue
        if name in LIBRARY.words:
            if not isinstance(value, bool):
                raise UsageError(f"option {name} is True or False, not {value!r}")
            place, becomes = LIBRARY.words[name]
            values[place] = becomes is value
        elif name in LIBRARY.values:
            several = LIBRARY.values[name].many and isinstance(value, list | tuple)
            for one in value if several and isinstance(value, list | tuple) else (value,):
                values[name] = LIBRARY.parsed(name, _as_text(name, one), values)
        elif not take_gone(values, name, "" if value is True else _as_text(name, value)):
            raise UsageError(f"unknown option {name!r}")
    return Options(**values)


def _as_text(name: str, value: object) -> str:
    """Return a keyword's value in the spelling of `-o`."""
    path = getattr(value, "__fspath__", None)
    text = value if path is None else path()
    if isinstance(text, bytes):
        text = text.decode("utf-8", "surrogateescape")
    if isinstance(text, bool) or not isinstance(text, str | int | float):
        raise UsageError(f"option {name} cannot be {value!r}")
    return str(text)


def at_source(spec: LinkSpec, options: Options) -> tuple[LinkSpec, Options]:
    """Return SOURCE and the options, with the `#subtree` of SOURCE as root, baud= at a serial port, and each
    endpoint of forward= once, in one spelling.

    Raises:
        UsageError: root= is given, too, or an endpoint is malformed.
    """
    endpoints = [parsed_by(parse_endpoint, "forward", text) for text in options.forward]
    options = replace(options, forward=tuple(dict.fromkeys(one.description for one in endpoints)))
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
