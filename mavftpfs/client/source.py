"""The meaning of SOURCE and the options: a link, or a mount. Layer: client."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace

import trio

from mavftpfs.client.files import Target, is_directory, open_mount
from mavftpfs.client.mounts import mountpoint_of, several_at
from mavftpfs.client.options import at_source
from mavftpfs.link.uri import parse_source, require_expanded
from mavftpfs.shared.errors import MavftpfsError, UsageError
from mavftpfs.shared.model import ROOT
from mavftpfs.shared.options import Options


def files_in_mount(source: str, paths: Sequence[str], *, lists: bool) -> tuple[str, list[str]] | None:
    """Return (mountpoint, paths on it) if SOURCE is itself a path to read, not a link or mount; otherwise
    None.

    A SOURCE in a mount that is not a directory is such a path: `crc ~/drone/log/*`, as a shell writes it.
    Then all `paths` must be in the same mount. A SOURCE without paths may be a directory, too, unless the
    command `lists` the root by default.

    Raises:
        UsageError: one of the paths is elsewhere, or the shell did not expand a `~` in SOURCE.
    """
    require_expanded(source)
    mount = mountpoint_of(source)
    if mount is None or mount[1] == ROOT or several_at(mount[0]) is not None:
        return None
    if (paths or lists) and trio.run(_may_be_directory, *mount):
        return None
    found = []
    for word in (source, *paths):
        other = mountpoint_of(word)
        if other is None or other[0] != mount[0]:
            raise UsageError(
                f"{source} is a file in the mount on {mount[0]}, and {word} is not in that mount"
            )
        found.append(os.fsdecode(other[1]))
    return mount[0], found


async def _may_be_directory(mountpoint: str, path: bytes) -> bool:
    """Return whether a path in a mount is a directory, or the mount cannot tell."""
    try:
        async with open_mount(mountpoint, ROOT, Options()) as session:
            return await is_directory(session.files, path)
    except MavftpfsError:
        return True


def target_of(source: str, options: Options) -> Target:
    """Return the target that SOURCE names, for a command or a program.

    Raises:
        UsageError: the text is not a SOURCE, or contradicts the options.
    """
    # A mount keeps editors' swap files in memory, but files from a command or a program are meant for the
    # card.
    options = replace(options, local=False)
    mount = mountpoint_of(source)
    if mount is not None:
        if options.root != ROOT:
            raise UsageError(f"{source} is a mount: name the directory in it, as {source}/dir")
        return Target(None, options, mount=mount)
    place = source.partition("#")[0]
    no_device = place.startswith("/") and not place.startswith("/dev/") and not os.path.lexists(place)
    if no_device or os.path.isdir(place):
        raise UsageError(f"no vehicle is mounted on {place}: mount one there, or give its link as SOURCE")
    return Target(*at_source(parse_source(source), options))
