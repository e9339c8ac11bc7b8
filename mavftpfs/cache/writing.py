"""Puts the writing half together. Layer: cache."""

from __future__ import annotations

from collections.abc import Callable
from random import Random

import trio

from mavftpfs.cache.asides import Namer, new_owner
from mavftpfs.cache.cleaning import Cleaner
from mavftpfs.cache.context import Context
from mavftpfs.cache.dentries import Dentries, Directory
from mavftpfs.cache.directories import Directories
from mavftpfs.cache.files import Files
from mavftpfs.cache.options import CacheOptions
from mavftpfs.cache.remote import RemoteStore, WriteStore
from mavftpfs.cache.spool import Spool, SpoolDirectory
from mavftpfs.cache.sure import Sure
from mavftpfs.cache.throttle import Throttle
from mavftpfs.cache.writeback import Writeback


def make_writeback(
    *,
    store: RemoteStore,
    writer: WriteStore,
    directories: Directories,
    dentries: Dentries,
    files: Files,
    options: CacheOptions,
    clock: Callable[[], float],
    wall: Callable[[], float],
    rng: Random,
    nursery: trio.Nursery | None,
    spool_directory: SpoolDirectory | None,
    on_changed: Callable[[bytes], None],
) -> Writeback:
    """Return the writing half over the reading half's parts, and have listings mended from now on.

    Without a spool directory what exceeds memory goes to one that does not outlive the process.
    `on_changed(path)`: the path, and what lies below it, is not what it was.
    """
    owner = new_owner(rng) if spool_directory is None else spool_directory.owner
    dead = frozenset[bytes]() if spool_directory is None else spool_directory.dead_owners
    context = Context(
        store=store,
        writer=writer,
        directories=directories,
        dentries=dentries,
        files=files,
        options=options,
        clock=clock,
        wall=wall,
        on_changed=on_changed,
        nursery=nursery,
        namer=Namer(owner, options.root, rng),
    )
    throttle = Throttle(context)
    spool = Spool(
        memory_max=lambda: throttle.limit,
        spool_max=options.spool_max,
        directory=None if spool_directory is None else spool_directory.path,
    )
    cleaner = Cleaner(context, Sure(context), dead)
    directories.on_swept = cleaner.on_swept
    files.is_changing = context.is_changing
    compare = directories.on_listed

    def on_listed(path: bytes, directory: Directory) -> None:
        compare(path, directory)
        context.on_listed(path, directory)

    directories.on_listed = on_listed
    return Writeback(context, spool, throttle, cleaner)
