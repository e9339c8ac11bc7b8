"""Saves what could not be delivered when a mount ends. Layer: cache."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path

from mavftpfs.cache.draft import Draft
from mavftpfs.cache.nodes import Node
from mavftpfs.cache.rescuing import free_name

PIECE = 1024 * 1024
MANIFEST = "manifest.json"


def recover(nodes: Iterable[Node], directory: Path, wall: Callable[[], float]) -> list[Path]:
    """Copy undelivered files into a directory, with a manifest that says what each is; return the files.

    Of a file that was changed in part only the bytes known here are there; the manifest lists them, the
    rest of such a file is a hole.

    Raises:
        OSError.
    """
    written: list[Path] = []
    manifest = []
    for node in nodes:
        if node.draft is None:
            continue
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        name = node.path.decode(errors="surrogateescape").strip("/").replace("/", "__")
        path = free_name(directory, name)
        _copy(node.draft, path)
        written.append(path)
        manifest.append({"file": path.name, **describe(node, node.draft, wall)})
    if written:
        target = free_name(directory, MANIFEST)
        target.write_text(json.dumps(manifest, indent=1))
    return written


def describe(node: Node, draft: Draft, wall: Callable[[], float]) -> dict[str, object]:
    """Return what a spooled file is, for people and JSON; `held` are the extents whose bytes are known."""
    return {
        "path": node.path.decode(errors="surrogateescape"),
        "size": draft.size,
        "whole": draft.whole,
        "held": list(draft.held),
        "changed": list(draft.changed),
        "size_on_vehicle": draft.remote_size,
        "error": None if node.error is None else str(node.error),
        "at": wall(),
    }


def _copy(draft: Draft, path: Path) -> None:
    with path.open("xb") as file:
        for start, stop in draft.held:
            file.seek(start)
            for at in range(start, stop, PIECE):
                file.write(draft.local_bytes(at, min(at + PIECE, stop)))
        file.truncate(draft.size)
