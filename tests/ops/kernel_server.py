"""Mounts a FakeTree for the mount tests: python -m tests.ops.kernel_server MOUNTPOINT CONTROL_SOCKET.

Takes one JSON object a line on stdin and answers each with one on stdout: {"do": "write", "path", "text"},
{"do": "invalidate", "path"}, {"do": "forget", "path"} for a name in the root, and {"do": "calls"}, which
gives the calls since the last time. Those for the root are left out: any program that looks at all mounts
makes them.
"""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pyfuse3
import trio

from mavftpfs.client.connect import Attached
from mavftpfs.link.uri import parse_source
from mavftpfs.mount.life import MountRequest
from mavftpfs.mount.single import SingleMount
from mavftpfs.shared.options import Options
from tests.ops.faketree import FakeTree

VALID_FOR = 1000.0
"""Seconds: so many that the kernel asks again only after a notice."""


class Server:
    """The tree and the commands that change it."""

    def __init__(self) -> None:
        many = {b"/many/%04d" % number: b"x" * number for number in range(1500)}
        small = {b"/a": b"one", b"/b": b"one", b"/c": b"one"}
        self.tree = FakeTree({**small, **many}, valid_for=VALID_FOR)

    @asynccontextmanager
    async def attach(self, invalidate: Callable[[bytes], None]) -> AsyncIterator[Attached]:
        """Stand in for a vehicle, of which nothing but its files is known."""
        async with trio.open_nursery() as nursery:
            nursery.start_soon(self.listen, invalidate)
            vehicle = SimpleNamespace(tree=self.tree, space=lambda: None, notice=str)
            vehicle.status = lambda: {"vehicle": {"system": 1, "component": 1}}
            vehicle.watcher = SimpleNamespace(run=trio.sleep_forever)
            yield cast(Attached, vehicle)
            nursery.cancel_scope.cancel()

    async def listen(self, invalidate: Callable[[bytes], None]) -> None:
        """Do what stdin says."""
        while line := await trio.to_thread.run_sync(sys.stdin.readline, abandon_on_cancel=True):
            print(json.dumps(self.obey(json.loads(line), invalidate)), flush=True)

    def obey(self, order: dict[str, Any], invalidate: Callable[[bytes], None]) -> dict[str, Any]:
        """Carry one command out."""
        path = order.get("path", "").encode()
        match order["do"]:
            case "write":
                self.tree.files[path] = order["text"].encode()
            case "invalidate":
                invalidate(path)
            case "forget":
                pyfuse3.invalidate_entry_async(pyfuse3.ROOT_INODE, path.removeprefix(b"/"))
            case "calls":
                names = [name for name, path in self.tree.calls if path != b"/"]
                self.tree.calls.clear()
                return {"calls": names}
        return {}


def main() -> int:
    """Mount until unmounted."""
    logging.basicConfig(level=logging.WARNING)
    source = "udpin:127.0.0.1:1"
    mountpoint, control = sys.argv[1:]
    request = MountRequest(
        source, parse_source(source), mountpoint, Options(read_only=True), control=Path(control)
    )
    return trio.run(SingleMount(request, Server().attach, report).run)


def report(code: int, message: str) -> None:
    """Say that it is mounted, or why not."""
    print(json.dumps({"code": code, "message": message}), flush=True)


if __name__ == "__main__":
    sys.exit(main())
