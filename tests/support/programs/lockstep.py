"""Random system calls, each made on a mount and on a local directory; stops at the first difference.

    python lockstep.py MOUNTED LOCAL CARD --seed 7 --count 500

MOUNTED: a directory of the mount. LOCAL: a directory of a local disk. CARD: where MOUNTED lies on the
vehicle, seen without the mount; `-` if that cannot be seen. The calls follow from the seed alone, so what
fails can be run again.

After each call the results are compared: bytes, sizes, offsets or errno. After an fsync or close that said
0 the file on the card must be the local one. Exit code 1 and a report if something differs.
"""

from __future__ import annotations

import argparse
import errno
import mmap
import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from random import Random
from typing import Any

FILES = ("a", "b", "c", "d/x", "d/y", "d/e/z", "f/w")
DIRECTORIES = ("d", "d/e", "f", "g")
SLOTS = 5
TAIL = 40
LARGE = 30_000
WAYS = (
    os.O_RDONLY,
    os.O_RDONLY | os.O_CREAT,
    os.O_RDONLY | os.O_TRUNC,
    os.O_WRONLY,
    os.O_RDWR,
    os.O_RDWR | os.O_CREAT,
    os.O_RDWR | os.O_CREAT,
    os.O_WRONLY | os.O_CREAT | os.O_TRUNC,
    os.O_RDWR | os.O_TRUNC,
    os.O_RDWR | os.O_CREAT | os.O_EXCL,
    os.O_WRONLY | os.O_CREAT | os.O_APPEND,
    os.O_RDWR | os.O_APPEND,
)

WEIGHTS = {
    "open": 22,
    "close": 14,
    "read": 8,
    "pread": 8,
    "write": 14,
    "pwrite": 12,
    "seek": 6,
    "ftruncate": 5,
    "truncate": 3,
    "fsync": 5,
    "duplicate": 2,
    "map": 4,
    "rename": 6,
    "move": 2,
    "unlink": 4,
    "mkdir": 3,
    "rmdir": 3,
    "stat": 4,
    "list": 4,
}


@dataclass(frozen=True)
class Call:
    """One call: its number in the sequence, its name and arguments."""

    number: int
    name: str
    args: tuple[Any, ...]

    def __str__(self) -> str:
        shown = (f"{len(arg)} bytes" if isinstance(arg, bytes) else repr(arg) for arg in self.args)
        return f"{self.number}: {self.name}({', '.join(shown)})"


def draw_data(rng: Random) -> bytes:
    """Return something to write."""
    return rng.randbytes(rng.choice((1, 10, 239, 240, 700, 2000, rng.randrange(1, 5000), LARGE)))


def draw_offset(rng: Random) -> int:
    """Return a place in a file or its new size."""
    return rng.choice((0, 0, 1, 239, 1000, 4096, rng.randrange(8000), rng.randrange(LARGE)))


def draw_call(rng: Random, number: int) -> Call:
    """Return the next call."""
    name = rng.choices(list(WEIGHTS), list(WEIGHTS.values()))[0]
    slot, path, folder = rng.randrange(SLOTS), rng.choice(FILES), rng.choice(DIRECTORIES)
    args: dict[str, Callable[[], tuple[Any, ...]]] = {
        "open": lambda: (slot, path, rng.choice(WAYS)),
        "close": lambda: (slot,),
        "read": lambda: (slot, rng.choice((1, 100, 5000, 2 * LARGE))),
        "pread": lambda: (slot, draw_offset(rng), rng.choice((1, 100, 5000, 2 * LARGE))),
        "write": lambda: (slot, draw_data(rng)),
        "pwrite": lambda: (slot, draw_offset(rng), draw_data(rng)),
        "seek": lambda: (slot, draw_offset(rng), rng.choice((os.SEEK_SET, os.SEEK_CUR, os.SEEK_END))),
        "ftruncate": lambda: (slot, draw_offset(rng)),
        "truncate": lambda: (path, draw_offset(rng)),
        "fsync": lambda: (slot, rng.random() < 0.3),
        "duplicate": lambda: (slot, rng.randrange(SLOTS)),
        "map": lambda: (slot, rng.random(), draw_data(rng)),
        "rename": lambda: (path, rng.choice(FILES)),
        "move": lambda: (folder, rng.choice(DIRECTORIES)),
        "unlink": lambda: (rng.choice((path, path, path, folder)),),
        "mkdir": lambda: (folder,),
        "rmdir": lambda: (rng.choice((folder, folder, folder, path)),),
        "stat": lambda: (path,),
        "list": lambda: (rng.choice((*DIRECTORIES, ".")),),
    }
    return Call(number, name, args[name]())


def draw_calls(seed: int, count: int) -> list[Call]:
    """Return the calls of a seed; the beginning of a longer sequence is the shorter one."""
    rng = Random(seed)
    start = [Call(-1, "mkdir", ("d",)), Call(-1, "mkdir", ("d/e",)), Call(-1, "mkdir", ("f",))]
    return [*start, *(draw_call(rng, number) for number in range(count))]


class Side:
    """One of the two directories, and the files open there."""

    def __init__(self, root: str) -> None:
        self.root = root
        self.slots: dict[int, int] = {}
        """Inodes of files that lost their name to another file."""

    def do(self, call: Call) -> Any:
        """Make a call and return what it said: a value, or the name of the errno."""
        try:
            return getattr(self, "on_" + call.name)(*call.args)
        except OSError as error:
            return errno.errorcode[error.errno or 0]
        except KeyError:
            return "slot not open"

    def place(self, path: str) -> str:
        """Return the real path."""
        return os.path.join(self.root, path)

    def on_open(self, slot: int, path: str, flags: int) -> str:
        if slot in self.slots:
            return "slot in use"
        self.slots[slot] = os.open(self.place(path), flags)
        return "opened"

    def on_close(self, slot: int) -> None:
        os.close(self.slots.pop(slot))

    def on_duplicate(self, slot: int, other: int) -> str:
        number = self.slots[slot]
        if other in self.slots:
            return "slot in use"
        self.slots[other] = os.dup(number)
        return "duplicated"

    def on_read(self, slot: int, size: int) -> bytes:
        return os.read(self.slots[slot], size)

    def on_pread(self, slot: int, offset: int, size: int) -> bytes:
        return os.pread(self.slots[slot], size, offset)

    def on_write(self, slot: int, data: bytes) -> int:
        return os.write(self.slots[slot], data)

    def on_pwrite(self, slot: int, offset: int, data: bytes) -> int:
        return os.pwrite(self.slots[slot], data, offset)

    def on_seek(self, slot: int, offset: int, whence: int) -> int:
        return os.lseek(self.slots[slot], offset if whence != os.SEEK_END else -(offset // 8), whence)

    def on_ftruncate(self, slot: int, size: int) -> None:
        os.ftruncate(self.slots[slot], size)

    def on_truncate(self, path: str, size: int) -> None:
        os.truncate(self.place(path), size)

    def on_fsync(self, slot: int, only_data: bool) -> None:
        (os.fdatasync if only_data else os.fsync)(self.slots[slot])

    def on_map(self, slot: int, where: float, data: bytes) -> Any:
        number = self.slots[slot]
        size = os.fstat(number).st_size
        if size == 0:
            return "nothing to map"
        with mmap.mmap(number, size) as memory:
            start = int(where * size)
            stop = min(size, start + len(data))
            before = memory[start:stop]
            memory[start:stop] = data[: stop - start]
            memory.flush()
        return before

    def on_rename(self, old: str, new: str) -> None:
        os.rename(self.place(old), self.place(new))

    on_move = on_rename

    def on_unlink(self, path: str) -> None:
        os.unlink(self.place(path))

    def on_mkdir(self, path: str) -> None:
        os.mkdir(self.place(path))

    def on_rmdir(self, path: str) -> None:
        os.rmdir(self.place(path))

    def on_stat(self, path: str) -> tuple[int, int]:
        found = os.stat(self.place(path))
        return found.st_size, found.st_mode >> 12

    def on_list(self, path: str) -> list[str]:
        return sorted(name for name in os.listdir(self.place(path)) if name != "@PARAM")

    def needs_old_bytes(self, call: Call) -> bool:
        """Return whether a call reads an open file without a name: a mount need not have its bytes."""
        number = self.slots.get(call.args[0]) if call.name in ("read", "pread", "map") else None
        return number is not None and self.name_of(number) is None

    def size_of(self, slot: int) -> int:
        """Return the size of an open file, -1 if the slot is free."""
        return os.fstat(self.slots[slot]).st_size if slot in self.slots else -1

    def name_of(self, number: int) -> str | None:
        """Return the path of an open file, None if it lost its name."""
        meant = os.fstat(number)
        for path in FILES:
            try:
                found = os.stat(self.place(path))
            except OSError:
                continue
            if (found.st_ino, found.st_dev) == (meant.st_ino, meant.st_dev):
                return path
        return None


def confirmed(local: Side, call: Call) -> str | None:
    """Return the path that a call, if it says 0, promises to be on the card; asked before the call."""
    number = local.slots.get(call.args[0]) if call.name in ("fsync", "close") else None
    if number is None or not writable(number):
        return None
    path = local.name_of(number)
    if path is None or (call.name == "close" and os.fstat(number).st_size == 0):
        return None  # an empty file is brought at release, which close() does not await
    return path


def writable(number: int) -> bool:
    """Return whether a descriptor may write."""
    with open(f"/proc/self/fdinfo/{number}") as info:
        flags = next(int(line.split()[1], 8) for line in info if line.startswith("flags:"))
    return flags & os.O_ACCMODE != os.O_RDONLY


def difference(mounted: Side, local: Side, card: str, call: Call) -> str | None:
    """Make a call on both sides; return what differs, None if nothing does."""
    promised = confirmed(local, call)
    if local.needs_old_bytes(call):
        return None
    expected, result = local.do(call), mounted.do(call)
    if expected != result:
        return f"expected {shown(expected)}, got {shown(result)}"
    slot = call.args[0]
    if isinstance(slot, int) and local.size_of(slot) != mounted.size_of(slot):
        return f"expected size {local.size_of(slot)}, got {mounted.size_of(slot)}"
    if promised is not None and expected is None and card != "-":
        return compare_file(local.place(promised), os.path.join(card, promised))
    return None


def shown(result: Any) -> str:
    """Return a short form of a result."""
    if isinstance(result, bytes):
        return f"{len(result)} bytes {result[:12].hex()}.."
    return repr(result)


def compare_file(expected: str, place: str) -> str | None:
    """Return how a file on the card differs from the local one."""
    try:
        with open(expected, "rb") as one, open(place, "rb") as other:
            left, right = one.read(), other.read()
    except OSError as error:
        return f"on the card: {error}"
    if left == right:
        return None
    first = next((i for i, (a, b) in enumerate(zip(left, right, strict=False)) if a != b), len(left))
    return f"on the card {place}: {len(right)} bytes instead of {len(left)}, first difference at {first}"


def ending(local: Side) -> Iterator[Call]:
    """Yield what closes and compares everything."""
    yield from [Call(-2, "close", (slot,)) for slot in sorted(local.slots)]
    yield from [Call(-2, "list", (path,)) for path in (*DIRECTORIES, ".")]
    yield from [Call(-2, "stat", (path,)) for path in FILES]


def main() -> int:
    """Run the sequence."""
    parser = argparse.ArgumentParser()
    parser.add_argument("mounted")
    parser.add_argument("local")
    parser.add_argument("card")
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--count", type=int, required=True)
    args = parser.parse_args()
    mounted, local = Side(args.mounted), Side(args.local)
    done: list[str] = []

    def run(call: Call) -> bool:
        found = difference(mounted, local, args.card, call)
        done.append(str(call))
        if found is not None:
            print(f"seed {args.seed}: {found}\nthe last calls:", *done[-TAIL:], sep="\n")
        return found is None

    everything = all(run(call) for call in draw_calls(args.seed, args.count))
    return 0 if everything and all(run(call) for call in ending(local)) else 1


if __name__ == "__main__":
    sys.exit(main())
