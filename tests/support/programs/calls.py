"""System calls that change files, in the working directory; prints what each says, the same on any disk.

python calls.py [without-names]     # leaves out what removes and renames
"""

from __future__ import annotations

import mmap
import os
import sys
from collections.abc import Callable


def put(name: str, data: bytes) -> None:
    with open(name, "wb") as file:
        file.write(data)


def shared_mapping() -> None:
    put("mapped", bytes(10000))
    with open("mapped", "r+b") as file:
        with mmap.mmap(file.fileno(), 0) as memory:
            memory[100:105] = b"mmap!"
            memory[9000:9003] = b"end"
            memory.flush()
        os.fsync(file.fileno())
    with open("mapped", "rb") as file:
        print("zeros", file.read().count(0))
    number = os.open("extended", os.O_RDWR | os.O_CREAT)
    os.ftruncate(number, 5000)
    with mmap.mmap(number, 5000) as memory:
        memory[4990:5000] = b"0123456789"
    os.close(number)


def two_that_append() -> None:
    one = os.open("log", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    two = os.open("log", os.O_WRONLY | os.O_APPEND)
    for number in range(20):
        os.write(one, b"one %d\n" % number)
        os.write(two, b"two %d\n" % number)
    os.close(one)
    os.close(two)


def exclusive() -> None:
    try:
        os.open("log", os.O_CREAT | os.O_EXCL | os.O_WRONLY)
    except FileExistsError:
        print("exists")
    number = os.open("fresh", os.O_CREAT | os.O_EXCL | os.O_RDWR)
    os.write(number, b"x" * 700)
    os.lseek(number, 100, 0)
    print(os.read(number, 5))
    os.pwrite(number, b"QQ", 350)
    os.ftruncate(number, 600)
    os.fsync(number)
    print(os.fstat(number).st_size)
    os.close(number)


def two_writers() -> None:
    with open("shared", "wb", 0) as one, open("shared", "r+b", 0) as two, open("shared", "rb", 0) as reader:
        one.write(b"1" * 1000)
        two.seek(500)
        two.write(b"2" * 1000)
        one.write(b"3" * 100)
        data = reader.read()
        print(len(data), data.count(b"1"), data.count(b"2"), data.count(b"3"))


def duplicates() -> None:
    number = os.open("dup", os.O_CREAT | os.O_WRONLY)
    other = os.dup(number)
    os.write(number, b"before ")
    os.close(number)
    os.write(other, b"after")
    os.close(other)
    with open("dup", "rb") as file:
        print(file.read())


def without_a_name() -> None:
    put("gone", b"still" * 100)
    with open("gone", "rb") as file:
        os.unlink("gone")
        print(len(file.read()), os.path.exists("gone"))
    with open("gone", "wb") as writer:
        writer.write(b"lost" * 100)
        writer.flush()
        os.unlink("gone")
        writer.write(b"more")
    put("moved", b"a" * 300)
    with open("moved", "r+b") as file:
        os.rename("moved", "moved2")
        file.seek(100)
        file.write(b"b" * 300)


def refusals() -> None:
    os.mkdir("full")
    put("full/f", b"1")
    calls: list[Callable[[], object]] = [
        lambda: os.rmdir("full"),
        lambda: os.unlink("full"),
        lambda: os.rmdir("full/f"),
        lambda: os.mkdir("full"),
        lambda: os.mkdir("nothing/x"),
        lambda: os.open("nothing", os.O_WRONLY),
        lambda: os.open("full", os.O_WRONLY),
        lambda: os.open("full/f/g", os.O_WRONLY | os.O_CREAT),
        lambda: os.rename("full", "full/in"),
        lambda: os.rename("nothing", "fresh"),
        lambda: os.rename("fresh", "full"),
        lambda: os.rename("full", "fresh"),
        lambda: os.truncate("nothing", 5),
        lambda: os.truncate("full", 5),
        lambda: os.unlink("nothing"),
        lambda: os.rmdir("nothing"),
    ]
    for call in calls:
        try:
            call()
            print("worked")
        except OSError as error:
            print(error.strerror)


def main() -> None:
    """Run all of it."""
    shared_mapping()
    two_that_append()
    exclusive()
    two_writers()
    duplicates()
    if sys.argv[1:] != ["without-names"]:
        without_a_name()
        refusals()


if __name__ == "__main__":
    main()
