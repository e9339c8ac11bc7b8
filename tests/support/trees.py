"""Reference trees with deterministic content, and a byte-for-byte comparison that runs as its own process.

    python -m tests.support.trees compare EXPECTED ACTUAL     # prints each difference, exit 1 if there is one

A mount is only ever touched from a process of its own, so that a hanging mount cannot hang the tests.
"""

from __future__ import annotations

import os
import random
import sys
from collections.abc import Iterator
from pathlib import Path

AWKWARD_SIZES = (0, 1, 238, 239, 240, 478, 35850, 40152, 119500, 131073, 1_000_000)
"""Around one chunk (239), exact bursts of MAVSDK (150 * 239), PX4 (168 * 239) and ArduPilot (500 * 239),
one byte more than a kernel read, and a megabyte."""

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

MANY = 300
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


def differing(expected: bytes, actual: bytes) -> Iterator[str]:
    """Yield a line for each difference of two trees: names, kinds, sizes, bytes. `@` trees are left out."""
    left = dict(walk(expected))
    right = {path: kind for path, kind in walk(actual) if not path.startswith(b"@")}
    for path in sorted(left.keys() | right.keys()):
        if left.get(path) != right.get(path):
            yield f"{path!r}: expected {left.get(path, 'nothing')}, is {right.get(path, 'nothing')}"
        elif left[path] == "file":
            yield from differing_file(os.path.join(expected, path), os.path.join(actual, path))


def differing_file(expected: bytes, actual: bytes) -> Iterator[str]:
    """Yield a line if size or bytes differ."""
    with open(expected, "rb") as file:
        left = file.read()
    size = os.stat(actual).st_size
    with open(actual, "rb") as file:
        right = file.read()
    if size != len(left):
        yield f"{actual!r}: stat says {size} bytes, expected {len(left)}"
    if left != right:
        pairs = enumerate(zip(left, right, strict=False))
        first = next((i for i, (a, b) in pairs if a != b), min(len(left), len(right)))
        yield f"{actual!r}: {len(right)} bytes, first difference at {first}"


def main() -> int:
    """Compare the two trees named on the command line."""
    command, expected, actual = sys.argv[1:]
    assert command == "compare"
    differences = list(differing(os.fsencode(expected), os.fsencode(actual)))
    print(*differences, sep="\n")
    return 1 if differences else 0


if __name__ == "__main__":
    sys.exit(main())
