"""Reference trees with deterministic content, and a byte-for-byte comparison.

A mount is only ever touched from a process of its own, so that a hanging mount cannot hang the tests.
"""

from __future__ import annotations

import os
import random
import subprocess
from collections.abc import Iterator
from pathlib import Path

AWKWARD_SIZES = (0, 1, 238, 239, 240, 478, 35850, 40152, 119500, 131073)
"""Around one chunk (239), exact bursts of MAVSDK (150 * 239), PX4 (168 * 239) and ArduPilot (500 * 239),
and one byte more than a kernel read."""

SMALL_SIZES = tuple(size for size in AWKWARD_SIZES if size <= 40152)

NAMES = (
    b"with some  spaces.txt",
    "flügel-plan-飛行-🛩.txt".encode(),
    b"-starts-with-a-dash",
    b'quote\'s and "doubles"',
    b"percent%20and#hash?query",
    b"..twodots",
    b"caf\xe9-not-utf8.txt",
    b"n" * 96 + b".txt",
)
"""Names that a shell, a URL or a decoder may trip over; none differs from another by case alone."""

MANY = 60
DEPTH = 12


def content(name: str, size: int) -> bytes:
    """Return `size` bytes that depend on the name alone."""
    return random.Random(name).randbytes(size)


def build_sizes(root: Path, sizes: tuple[int, ...]) -> None:
    """Files of each size, and runs of zeros as MAVLink 2 trims them and a CRC32 with init 0 ignores them."""
    folder = root / "sizes"
    folder.mkdir()
    for size in sizes:
        (folder / f"{size}.bin").write_bytes(content(f"sizes/{size}", size))
    (folder / "zero_tail.bin").write_bytes(content("tail", 500) + bytes(978))
    (folder / "zero_head.bin").write_bytes(bytes(700) + content("head", 100))


def build_names(root: Path) -> None:
    """Awkward names for files and directories."""
    folder = os.fsencode(root / "names")
    os.mkdir(folder)
    for number, name in enumerate(NAMES):
        with open(os.path.join(folder, name), "wb") as file:
            file.write(content(f"names/{number}", 10 + number))
    nested = os.path.join(folder, "Ordner für Läufe".encode())
    os.mkdir(nested)
    with open(os.path.join(nested, b"inner file"), "wb") as file:
        file.write(b"inner\n")


def build_deep(root: Path) -> None:
    """A chain of directories with a file at each step."""
    folder = root / "deep"
    for level in range(DEPTH):
        folder.mkdir()
        (folder / f"at{level}.txt").write_text(f"level {level}\n")
        folder = folder / f"d{level}"


def build_many(root: Path, count: int) -> None:
    """One directory that needs many listing pages."""
    folder = root / "many"
    folder.mkdir()
    for number in range(count):
        (folder / f"file_{number:04}.txt").write_bytes(content(f"many/{number}", number % 5))


def build_tree(root: Path, *, sizes: tuple[int, ...] = AWKWARD_SIZES, many: int = MANY) -> Path:
    """Fill the existing, empty directory `root` and return it."""
    (root / "README.txt").write_text("What lies on the card of a simulated vehicle.\n")
    (root / "empty").mkdir()
    build_sizes(root, sizes)
    build_names(root)
    build_deep(root)
    build_many(root, many)
    return root


def walk(root: bytes) -> Iterator[tuple[bytes, str]]:
    """Yield (relative path, kind) of everything below `root`; os.walk's errors are raised."""

    def fail(error: OSError) -> None:
        raise error

    for folder, directories, files in os.walk(root, onerror=fail):
        for names, kind in ((directories, "directory"), (files, "file")):
            for name in names:
                yield os.path.relpath(os.path.join(folder, name), root), kind


COMPARE = ("diff", "-r", "--no-dereference", "--exclude=@*")
"""Prints each difference of two directories: names, kinds, bytes. `@` trees are left out."""


def differing(expected: Path, actual: Path) -> list[str]:
    """Return a line for each difference of two local trees."""
    done = subprocess.run(
        [*COMPARE, expected, actual], capture_output=True, text=True, errors="replace", check=False
    )
    return (done.stdout + done.stderr).splitlines()
