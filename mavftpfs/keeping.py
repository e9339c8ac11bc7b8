"""`cache_dir=`: what mounts of one vehicle keep of its files on the local disk. Layer: top."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import trio

from mavftpfs.cache.blocks import BlockCache
from mavftpfs.cache.dentries import Dentries
from mavftpfs.cache.kept import Facts, KeptCache, vehicle_identity
from mavftpfs.cache.kept_disk import KeptDisk
from mavftpfs.fuse.options import MountOptions
from mavftpfs.session.connection import Connection
from mavftpfs.shared.errors import UsageError
from mavftpfs.shared.model import DirEntry, split

MakeKept = Callable[[BlockCache, Dentries], KeptCache]

DISK_PART = 16
"""The directory may hold about so many times cache_size: 1 GB, if that is not changed."""

PATIENCE = 5.0
"""Seconds to wait for AUTOPILOT_VERSION before files are opened: what is read without it is not kept."""

_POLL = 0.02


async def kept_for(options: MountOptions, connection: Connection) -> MakeKept | None:
    """Return what makes a tree's kept cache, None without cache_dir; waits until the vehicle said who it is.

    Raises:
        UsageError: the directory cannot be used.
    """
    if options.cache_dir is None:
        return None
    try:
        directory = KeptDisk(Path(options.cache_dir), DISK_PART * options.cache_size)
    except OSError as exc:
        raise UsageError(f"cache_dir={options.cache_dir}: {exc.strerror}") from exc

    with trio.move_on_after(PATIENCE):
        while connection.vehicle.version is None:  # noqa: ASYNC110 (asked for once per mount)
            await trio.sleep(_POLL)

    def make(cache: BlockCache, dentries: Dentries) -> KeptCache:
        facts = Facts(
            identity=partial(identity, connection),
            remembered=partial(_remembered, dentries),
            growing=lambda path: dentries.is_growing(path, trio.current_time()),
            crc32=connection.store.crc32,
            crc_limit=partial(crc_limit, options, connection),
            wall=time.time,
            clock=cache.clock,
        )
        return KeptCache(directory, facts)

    return make


def identity(connection: Connection) -> bytes | None:
    """Return what tells the vehicle from others; None before it said so, and after it restarted: then it may
    be another one, or its firmware."""
    vehicle = connection.vehicle
    if vehicle.version is None or vehicle.reboots:
        return None
    version = vehicle.version
    return vehicle_identity(version.uid, version.uid2, version.flight_sw_version, version.git_hash)


def crc_limit(options: MountOptions, connection: Connection) -> int:
    """Return the size in bytes of the largest file whose checksum may be asked for now."""
    allowed = options.verify in ("auto", "crc") and not connection.vehicle.armed
    return options.verify_max if allowed else 0


def _remembered(dentries: Dentries, path: bytes) -> DirEntry | None:
    parent, name = split(path)
    directory = dentries.known(parent)
    return None if directory is None else directory.entries.get(name)
