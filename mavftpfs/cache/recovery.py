"""Saves what could not be delivered when a mount ends. Layer: cache."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import BinaryIO

from mavftpfs.cache.draft import Draft
from mavftpfs.cache.nodes import Node
from mavftpfs.cache.rescuing import free_name
from mavftpfs.shared.errors import SpoolFailed
from mavftpfs.shared.private import make_private_directory, open_private

log = logging.getLogger("mavftpfs.cache")

PIECE = 1024 * 1024
MANIFEST = "manifest.json"


def recover(nodes: Iterable[Node], directory: Path, wall: Callable[[], float]) -> list[Path]:
    """Copy undelivered files into a directory, with a manifest that says what each is; return the copies.

    Of a file that was changed in part only the bytes known here are there; the manifest lists them, the
    rest of such a file is a hole. A file that is copied is held no longer. One that the local disk does not
    give back stays where it is, for the next mount, and costs no other: the manifest says why under
    `not_saved`; what could be read of it may be there, too.

    Raises:
        OSError, SpoolFailed: nothing could be copied.
    """
    copied: list[tuple[Node, Path]] = []
    failed: list[OSError | SpoolFailed] = []
    manifest = []
    for node in nodes:
        if node.draft is None:
            continue
        make_private_directory(directory)
        name = node.path.decode(errors="surrogateescape").strip("/").replace("/", "__")
        path = free_name(directory, name)
        facts = {"file": path.name, **describe(node, node.draft, wall)}
        try:
            _copy(node.draft, path)
            copied.append((node, path))
        except (OSError, SpoolFailed) as error:
            log.error("%r could not be saved: %s", node.path, error)
            failed.append(error)
            facts["not_saved"] = str(error)
        manifest.append(facts)
    if failed and not copied:
        raise failed[0]
    if copied:
        with _created(free_name(directory, MANIFEST)) as file:
            file.write(json.dumps(manifest, indent=1).encode())
    for node, _ in copied:
        node.drop_draft()  # the spool need not offer it again
    return [path for _, path in copied]


def describe(node: Node, draft: Draft, wall: Callable[[], float]) -> dict[str, object]:
    """Return what a spooled file is, for people and JSON; `held` are the extents whose bytes are known."""
    return {
        "path": node.path.decode(errors="surrogateescape"),
        "size": draft.size,
        "whole": draft.whole,
        "held": list(draft.held),
        "changed": list(draft.changed),
        "size_on_vehicle": None if draft.base is None else draft.base.size,
        "error": None if node.error is None else str(node.error),
        "at": wall(),
    }


def _created(path: Path) -> BinaryIO:
    return open(open_private(path, os.O_WRONLY | os.O_EXCL), "wb")


def _copy(draft: Draft, path: Path) -> None:
    with _created(path) as file:
        for start, stop in draft.held:
            file.seek(start)
            for at in range(start, stop, PIECE):
                file.write(draft.local_bytes(at, min(at + PIECE, stop)))
        file.truncate(draft.size)
