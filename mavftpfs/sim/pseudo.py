"""ArduPilot's virtual `@` trees, which lie about sizes. Layer: sim; pure.

Source: servers.md 11; AP_Filesystem_Param, _Sys, _Mission, _ROMFS. The parameter packing reproduces a
recorded download byte for byte.
"""

from __future__ import annotations

import errno
import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

from mavftpfs.sim.tree import Entry, Kind, Stat, fail

TREES = (b"@SYS", b"@ROMFS", b"@PARAM", b"@MISSION")
PARAM_MAGIC = 0x671B
MISSION_MAGIC = 0x763D
MAX_HANDLES = 4
_PARAM_HEADER = struct.Struct("<HHH")
_MISSION_HEADER = struct.Struct("<HHHHH")
_SYS_CLAIM = 100_000
_MISSION_CLAIM = 2**20
_MISSIONS = (b"mission.dat", b"fence.dat", b"rally.dat")
_FORMATS = {1: "<b", 2: "<h", 3: "<i", 4: "<f"}
_REAL_SIZES = (b"storage.bin",)
_STORAGE = bytes(i * 31 % 251 for i in range(16_384))
_SYS_NAMES = (
    b"threads.txt tasks.txt dma.txt memory.txt uarts.txt timers.txt can_log.txt can0_stats.txt "
    b"can1_stats.txt crash_dump.bin storage.bin"
).split()


class Param(NamedTuple):
    """A parameter: type 1 int8, 2 int16, 3 int32, 4 float; `value` as stored, little-endian."""

    name: bytes
    type: int
    value: bytes


def param(name: str, kind: int, value: float) -> Param:
    """Build a parameter from a number."""
    return Param(name.encode(), kind, struct.pack(_FORMATS[kind], value if kind == 4 else int(value)))


def pack_parameters(params: Sequence[Param], block: int) -> bytes:
    """Return param.pck as read in blocks of `block` bytes: no value crosses a block's end."""
    out = bytearray(_PARAM_HEADER.pack(PARAM_MAGIC, len(params), len(params)))
    last = b""
    for name, kind, value in params:
        common = _common_prefix(last, name)
        record = bytes([kind, common | (len(name) - common - 1) << 4]) + name[common:] + value
        over = (len(out) + len(record)) % block
        if len(value) > 1 and 0 < over < len(value):
            out += bytes(len(value) - over)
        out += record
        last = name
    return bytes(out)


def _common_prefix(last: bytes, name: bytes) -> int:
    limit = min(len(last), len(name) - 1, 15)
    return next((i for i in range(limit) if last[i] != name[i]), max(limit, 0))


def _default_params() -> list[Param]:
    made = [param("FORMAT_VERSION", 2, 120), param("SYSID_THISMAV", 2, 1)]
    made += [param(f"SERVO{i}_{part}", 2, 1000 + i) for i in range(1, 17) for part in ("MIN", "MAX", "TRIM")]
    made += [param(f"INS_GYR{i}OFFS_{axis}", 4, i / 64) for i in range(1, 4) for axis in "XYZ"]
    return made


def _default_sys() -> dict[bytes, bytes]:
    files = dict.fromkeys(_SYS_NAMES, b"")
    files[b"tasks.txt"] = b"TasksV2\n"
    files[b"uarts.txt"] = b"UARTV1\n" + b"".join(
        b"SERIAL%d TX=%8d RX=%8d TXBD=%6d RXBD=%6d\n" % (i, i * 1000, i * 900, 5760, 5760) for i in range(8)
    )
    files[b"storage.bin"] = _STORAGE
    return files


def _default_romfs() -> dict[bytes, bytes]:
    return {
        b"locations.txt": b"".join(b"SITE%d=%d.5,149.1,584,353\n" % (i, i) for i in range(150)),
        b"models/quad.json": b'{"mass": 3.0}\n',
    }


class VirtualTrees:
    """The trees of one vehicle.

    trees: their names. exact: claimed sizes are right (PX4 of 2026).
    """

    def __init__(
        self,
        trees: Sequence[bytes] = TREES,
        *,
        exact: bool = False,
        params: Iterable[Param] | None = None,
        sys_files: Mapping[bytes, bytes] | None = None,
        romfs: Mapping[bytes, bytes] | None = None,
    ) -> None:
        self._exact = exact
        self.params = list(params) if params is not None else _default_params()
        self.sys_files = dict(sys_files) if sys_files is not None else _default_sys()
        self.romfs = dict(romfs) if romfs is not None else _default_romfs()
        self._open = dict.fromkeys(trees, 0)
        self._leaked_listings = 0

    def reboot(self) -> None:
        """Forget open handles and leaked directory slots."""
        self._open = dict.fromkeys(self._open, 0)
        self._leaked_listings = 0

    def owns(self, path: bytes) -> bool:
        """Whether the path lies in one of these trees; one leading slash does not matter."""
        tree = path.removeprefix(b"/").partition(b"/")[0]
        return tree in self._open

    def roots(self) -> list[bytes]:
        """Return the trees that a listing of `/` shows."""
        return [tree for tree in (b"@ROMFS", b"@SYS") if tree in self._open]

    def entries(self, path: bytes) -> list[Entry]:
        """List @SYS or a directory of @ROMFS; ENOENT for the rest.

        Listing a missing @ROMFS directory leaks one of four slots; then every @ROMFS listing is ENFILE.
        """
        tree, name = self._split(path)
        if tree == b"@SYS" and not name:
            return [Entry(file, self.stat(b"@SYS/" + file)) for file in self.sys_files]
        if tree == b"@ROMFS":
            return self._romfs_entries(name)
        raise fail(errno.ENOENT, path)

    def _romfs_entries(self, name: bytes) -> list[Entry]:
        if self._leaked_listings >= MAX_HANDLES:
            raise fail(errno.ENFILE, name)
        prefix = name + b"/" if name else b""
        found: dict[bytes, Stat] = {}
        for file, content in self.romfs.items():
            if file.startswith(prefix):
                head, slash, _ = file[len(prefix) :].partition(b"/")
                kind = Kind.DIRECTORY if slash else Kind.FILE
                found[head] = Stat(kind, 0 if slash else len(content), 0)
        if not found:
            self._leaked_listings += 1
            raise fail(errno.ENOENT, name)
        return [Entry(file, stat) for file, stat in found.items()]

    def stat(self, path: bytes) -> Stat:
        """Describe a file with the size that the firmware claims."""
        tree, name = self._split(path)
        if not name:
            raise fail(errno.ENOENT, path)
        return Stat(Kind.FILE, self._claimed_size(tree, name), 0)

    def _claimed_size(self, tree: bytes, name: bytes) -> int:
        content = self._content(tree, name, 239)
        if self._exact or tree == b"@ROMFS" or name in _REAL_SIZES:
            return len(content)
        if tree == b"@PARAM":
            return 12 * len(self.params)
        return _SYS_CLAIM if tree == b"@SYS" else _MISSION_CLAIM

    def content(self, path: bytes, block: int) -> bytes:
        """Return what a download in blocks of `block` bytes yields."""
        return self._content(*self._split(path), block)

    def _content(self, tree: bytes, name: bytes, block: int) -> bytes:
        if tree == b"@PARAM" and name.partition(b"?")[0] == b"param.pck":
            return pack_parameters(self._selected_params(name), block)
        if tree == b"@MISSION" and name in _MISSIONS:  # of no items
            return _MISSION_HEADER.pack(MISSION_MAGIC, _MISSIONS.index(name), 0, 0, 0)
        files = {b"@SYS": self.sys_files, b"@ROMFS": self.romfs}.get(tree, {})
        if name not in files:
            raise fail(errno.ENOENT, name)
        return files[name]

    def _selected_params(self, name: bytes) -> list[Param]:
        start, count = 0, len(self.params)
        for option in name.partition(b"?")[2].split(b"&"):
            key, _, value = option.partition(b"=")
            if key == b"start" and value.isdigit():
                start = int(value)
            elif key == b"count" and value.isdigit():
                count = int(value)
        return self.params[start : start + count]

    def open(self, path: bytes, *, write: bool) -> VirtualFile:
        """Open a file; at most four at a time in each tree (ENFILE). What is written to it goes nowhere."""
        tree, name = self._split(path)
        if not name:
            raise fail(errno.ENOENT, path)
        if write and tree in (b"@SYS", b"@ROMFS"):
            raise fail(errno.EROFS, path)
        size = self._claimed_size(tree, name)
        if not write and not self._content(tree, name, 239):
            raise fail(errno.ENOENT, path)  # listed, yet not there (AP_Filesystem_Sys::open)
        if self._open[tree] >= MAX_HANDLES:
            raise fail(errno.ENFILE, path)
        self._open[tree] += 1
        return VirtualFile(
            lambda block: self._content(tree, name, block),
            size,
            one_block=tree == b"@PARAM",
            on_close=lambda: self._closed(tree),
        )

    def _closed(self, tree: bytes) -> None:
        self._open[tree] = max(0, self._open[tree] - 1)

    @staticmethod
    def _split(path: bytes) -> tuple[bytes, bytes]:
        tree, _, name = path.removeprefix(b"/").partition(b"/")
        return tree, name.strip(b"/")


class VirtualFile:
    """An open virtual file; the content is made at the first read.

    one_block: every read must ask for the size that the first one asked for, else EINVAL
    (AP_Filesystem_Param::read).
    """

    def __init__(
        self,
        make: Callable[[int], bytes],
        size: int,
        *,
        one_block: bool,
        on_close: Callable[[], None],
    ) -> None:
        self._make = make
        self._size = size
        self._one_block = one_block
        self._on_close = on_close
        self._block: int | None = None
        self._content = b""
        self._closed = False

    def read(self, offset: int, size: int) -> bytes:
        """See OpenFile."""
        if size == 0:
            return b""
        if self._block is None:
            self._block = size
            self._content = self._make(size)
        if self._one_block and size != self._block:
            raise fail(errno.EINVAL)
        return self._content[offset : offset + size]

    def write(self, offset: int, data: bytes) -> int:
        """See OpenFile."""
        return len(data)

    def size(self) -> int:
        """See OpenFile."""
        return self._size

    def close(self) -> None:
        """See OpenFile."""
        if not self._closed:
            self._closed = True
            self._on_close()
