"""Files of a vehicle are Python's: each call has the same outcome as on a local file."""

from __future__ import annotations

import io
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest

import mavftpfs
from tests.support.trees import content

OLD = content("old", 5_000)
Call = Callable[[Any], Any]


def into_buffer(file: Any) -> bytes:
    buffer = bytearray(300)
    return bytes(buffer[: file.readinto(buffer)])


BINARY: dict[str, Call] = {
    "read": lambda file: file.read(),
    "read some": lambda file: (file.read(10), file.tell(), file.read(0), file.read(1_000_000), file.read(1)),
    "readinto": into_buffer,
    "read1 and peek": lambda file: (file.read1(7) != b"", file.peek(1)[:1]),
    "lines": lambda file: list(file),
    "seek": lambda file: (file.seek(100), file.seek(5, os.SEEK_CUR), file.seek(-3, os.SEEK_END), file.read()),
    "seek too far": lambda file: (file.seek(9_000), file.read(), file.tell()),
    "bad seek": lambda file: file.seek(-1),
    "write": lambda file: (file.write(b"new"), file.write(b"er"), file.tell()),
    "write much": lambda file: (file.write(content("new", 300_000)), file.tell()),
    "write and read": lambda file: (file.write(b"abc"), file.seek(0), file.read(6)),
    "write beyond": lambda file: (file.seek(6_000), file.write(b"x")),
    "write a view": lambda file: file.write(memoryview(bytearray(b"abcdef"))[::2].tobytes()),
    "truncate": lambda file: (file.seek(7), file.truncate(), file.truncate(20), file.tell()),
    "truncate below zero": lambda file: (file.write(b"abc"), file.truncate(-1)),
    "flush": lambda file: (file.write(b"a"), file.flush()),
    "text": lambda file: file.write("a text"),
    "facts": lambda file: (file.readable(), file.writable(), file.seekable(), file.isatty(), file.closed),
    "closed": lambda file: (file.close(), file.close(), file.closed, file.read()),
    "with": lambda file: file.__enter__() is file,
}
TEXT: dict[str, Call] = {
    "read": lambda file: file.read(),
    "lines": lambda file: (file.readline(), list(file)),
    "write": lambda file: (file.write("größer\nals\r\n"), file.tell()),
    "seek": lambda file: (file.readline(), file.seek(file.tell()), file.read(3)),
    "print": lambda file: print("one", "two", file=file),
    "truncate": lambda file: (file.seek(0), file.truncate(2)),
    "facts": lambda file: (file.encoding, file.errors, file.newlines, file.mode),
}
MODES = ("r", "w", "a", "x", "r+", "w+", "a+", "x+")


def outcome(opened: Callable[[], Any], call: Call) -> object:
    """Return what came of it: a value, or a kind of error."""
    try:
        with opened() as file:
            return call(file)
    except (OSError, ValueError, TypeError, LookupError) as exc:
        return type(exc).__name__, getattr(exc, "errno", None)


def kept(path: Path) -> bytes | None:
    return path.read_bytes() if path.exists() else None


@pytest.mark.parametrize("exists", [True, False], ids=["there", "missing"])
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("buffering", [-1, 0])
def test_binary(
    shared: mavftpfs.Drone, card: Path, tmp_path: Path, mode: str, exists: bool, buffering: int
) -> None:
    for number, (name, call) in enumerate(BINARY.items()):
        if buffering == 0 and name == "read1 and peek":
            continue
        there, here = card / str(number), tmp_path / str(number)
        if exists:
            there.write_bytes(OLD)
            here.write_bytes(OLD)
        real = outcome(partial(open, here, mode + "b", buffering), call)
        ours = outcome(partial(shared.open, f"/{card.name}/{number}", mode + "b", buffering), call)
        assert (name, ours) == (name, real)
        assert (name, kept(there)) == (name, kept(here))


@pytest.mark.parametrize("mode", MODES)
def test_text(shared: mavftpfs.Drone, card: Path, tmp_path: Path, mode: str) -> None:
    for number, (name, call) in enumerate(TEXT.items()):
        there, here = card / str(number), tmp_path / str(number)
        if mode[0] != "x":
            for path in (there, here):
                path.write_bytes("größe\nein\r\nzwei".encode())
        real = outcome(partial(open, here, mode, encoding="utf-8"), call)
        ours = outcome(partial(shared.open, f"/{card.name}/{number}", mode), call)
        assert (name, ours) == (name, real)
        assert (name, kept(there)) == (name, kept(here))


@pytest.mark.parametrize(
    "args",
    [
        ("q",),
        ("rw",),
        ("",),
        ("r+w",),
        ("rbt",),
        ("rr",),
        ("+",),
        ("r", 0),
        ("rb", -1, "utf-8"),
        ("rb", -1, None, "strict"),
        ("rb", -1, None, None, "\n"),
        ("w", -1, "no-such-code"),
        ("w", -1, None, None, "x"),
    ],
)
def test_bad_arguments(shared: mavftpfs.Drone, card: Path, tmp_path: Path, args: tuple[Any, ...]) -> None:
    for path in (card / "f", tmp_path / "f"):
        path.write_bytes(OLD)
    real = outcome(partial(open, tmp_path / "f", *args), lambda file: None)
    assert outcome(partial(shared.open, f"/{card.name}/f", *args), lambda file: None) == real
    assert kept(card / "f") == OLD


def test_encodings_and_line_ends(shared: mavftpfs.Drone, card: Path) -> None:
    with shared.open(f"/{card.name}/f", "w", encoding="utf-16-le", newline="\r\n") as file:
        file.write("ä\n")
    assert (card / "f").read_bytes() == "ä\r\n".encode("utf-16-le")
    with shared.open(f"/{card.name}/f", encoding="ascii", errors="replace") as file:
        assert "\ufffd" in file.read()


def test_it_is_a_file_for_others(shared: mavftpfs.Drone, card: Path) -> None:
    with shared.open(f"/{card.name}/f", "wb") as file:
        assert isinstance(file, io.BufferedIOBase)
        assert file.name == f"/{card.name}/f"
        with pytest.raises(io.UnsupportedOperation):
            file.fileno()


def test_a_small_read_fetches_little_and_reading_on_fetches_all(shared: mavftpfs.Drone, card: Path) -> None:
    data = content("large", 400_000)
    (card / "large").write_bytes(data)

    def received() -> int:
        return int(shared.status()["link"]["received_bytes"])

    with shared.open(f"/{card.name}/large", "rb") as file:
        before = received()
        file.seek(150_000)
        assert file.read(1000) == data[150_000:151_000]
        assert received() - before < 20_000
        file.seek(0)
        assert b"".join(iter(lambda: file.read(1000), b"")) == data
