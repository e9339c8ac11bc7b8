"""The kernel's use of the mount's answers: sizes, pages, absences, inode numbers.

The tree behind the mount is in memory and says that everything is valid for 1000 s, so the kernel asks again
only where it is told to.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from mavftpfs.client.control import ask
from tests.support.mounts import abort_mount, unmount, wait_until
from tests.support.vehicles import PROJECT


class KernelServer:
    """A FakeTree mounted by a process of its own."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.control = path.parent / "control"
        argv = [sys.executable, "-m", "tests.ops.kernel_server", str(path), str(self.control)]
        self.process = subprocess.Popen(
            argv, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=PROJECT
        )
        assert self.answer() == {"code": 0, "message": ""}

    def answer(self) -> dict[str, Any]:
        """Read one line of the server."""
        assert self.process.stdout is not None
        facts: dict[str, Any] = json.loads(self.process.stdout.readline())
        return facts

    def do(self, what: str, **more: Any) -> dict[str, Any]:
        """Have the server do something."""
        assert self.process.stdin is not None
        print(json.dumps({"do": what, **more}), file=self.process.stdin, flush=True)
        return self.answer()

    def calls(self) -> list[str]:
        """Return what was asked of the tree since the last time."""
        return list(self.do("calls")["calls"])

    def counts(self) -> dict[str, int]:
        """Return what the kernel holds."""
        counts: dict[str, int] = ask(self.control, {"command": "status"}, timeout=20)["status"]["kernel"]
        return counts

    def run(self, code: str, *args: str | Path) -> str:
        """Run a snippet in another process: calls on the mount must not be this process's."""
        argv = [sys.executable, "-c", f"import os, sys\n{code}", *map(str, args)]
        return subprocess.run(argv, capture_output=True, text=True, timeout=90, check=True).stdout.strip()

    def read(self, name: str) -> str:
        """Return a file's text."""
        return self.run("print(open(sys.argv[1]).read(), end='')", self.path / name)

    def end(self) -> None:
        """Unmount; the process must end with 0."""
        try:
            unmount(self.path)
            assert self.process.wait(90) == 0
        finally:
            abort_mount(self.path)
            if self.process.poll() is None:
                self.process.kill()
            for stream in (self.process.stdin, self.process.stdout):
                assert stream is not None
                stream.close()
            self.process.wait(30)


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[KernelServer]:
    """One mount for all; each test has a file of its own."""
    path = tmp_path_factory.mktemp("kernel") / "mnt"
    path.mkdir()
    running = KernelServer(path)
    yield running
    running.end()


def test_one_listing_answers_the_stats_that_follow(server: KernelServer) -> None:
    server.calls()
    code = "print(sum(entry.stat().st_size for entry in os.scandir(sys.argv[1])))"
    assert server.run(code, server.path / "many") == str(sum(range(1500)))
    calls = server.calls()
    assert calls.count("list") == 1
    assert calls.count("stat") <= 2, "those of the directory itself"


@pytest.mark.parametrize(("name", "text"), [("a", "one and more"), ("b", "o")])
def test_a_file_that_grew_or_shrank_is_read_to_its_new_end_at_the_next_open(
    server: KernelServer, name: str, text: str
) -> None:
    """The kernel believes in the old size for 1000 s; without a word from us it ends the read there."""
    assert server.read(name) == "one"
    server.do("write", path=f"/{name}", text=text)
    assert server.read(name) == text
    assert server.run("print(os.stat(sys.argv[1]).st_size)", server.path / name) == str(len(text))


def test_pages_in_use_are_dropped_when_the_bytes_changed(server: KernelServer) -> None:
    reader = (
        "import os, sys\n"
        "fd = os.open(sys.argv[1], os.O_RDONLY)\n"
        "for _ in sys.stdin:\n    print(os.pread(fd, 9, 0).decode(), flush=True)"
    )
    argv = [sys.executable, "-c", reader, str(server.path / "c")]
    with subprocess.Popen(argv, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as child:

        def asks_the_server() -> bool:
            assert child.stdin is not None
            assert child.stdout is not None
            print(file=child.stdin, flush=True)
            assert child.stdout.readline() == "one\n"
            return "read" in server.calls()

        assert asks_the_server()
        assert not asks_the_server(), "the page is cached"
        server.do("invalidate", path="/c")
        wait_until("the kernel dropped the page", asks_the_server)


def test_an_absence_is_asked_for_once(server: KernelServer) -> None:
    code = "[os.path.exists(sys.argv[1]) for _ in range(50)]"
    server.calls()
    server.run(code, server.path / "nope")
    assert server.calls().count("stat") <= 2


def test_the_kernel_forgets_and_every_number_stays(server: KernelServer) -> None:
    code = "print({entry.name: entry.inode() for entry in os.scandir(sys.argv[1])})"
    before = server.run(code, server.path / "many")
    assert server.counts()["inodes"] > 1500
    server.do("forget", path="/many")  # of a directory the kernel drops all names below, too
    wait_until("forgotten", lambda: server.counts()["inodes"] < 10)
    assert server.run(code, server.path / "many") == before
    wait_until("released", lambda: server.counts()["open_directories"] == 0)


def test_handles_are_closed(server: KernelServer) -> None:
    server.run("[open(sys.argv[1]).close() for _ in range(100)]", server.path / "c")
    wait_until("released", lambda: server.counts()["open_files"] == 0)
