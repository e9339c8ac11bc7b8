"""ArduPilot's virtual `@` trees, which lie about sizes. Layer: sim; pure.

Source: servers.md 11 and 17; AP_Filesystem_Sys, _Mission, _ROMFS, and recordings.
"""

from __future__ import annotations

import errno
from collections.abc import Callable, Mapping, Sequence
from functools import partial

from mavftpfs.sim.missions import NAMES, MissionFile, Missions
from mavftpfs.sim.parameters import (
    FLOAT,
    INT8,
    INT16,
    INT32,
    LenientUpload,
    Parameter,
    ParameterFile,
    ParameterUpload,
    StrictUpload,
    Table,
    parameter,
    selection,
)
from mavftpfs.sim.profiles import TREES
from mavftpfs.sim.tree import ClaimedFile, Kind, OpenFile, Stat, TreeEntry, fail

MAX_HANDLES = 4
_SYS_CLAIM = 100_000
_MISSION_CLAIM = 2**20
_REAL_SIZES = (b"storage.bin",)
_STORAGE = bytes(i * 31 % 251 for i in range(16_384))
_SYS_NAMES = (
    b"threads.txt tasks.txt dma.txt memory.txt uarts.txt timers.txt can_log.txt can0_stats.txt "
    b"can1_stats.txt crash_dump.bin storage.bin"
).split()


def _default_parameters() -> list[Parameter]:
    made = [parameter("FORMAT_VERSION", INT16, 120), parameter("SYSID_THISMAV", INT16, 1)]
    made += [
        parameter(f"SERVO{i}_{part}", INT16, number + i, number)
        for i in range(1, 17)
        for part, number in (("MIN", 1100), ("MAX", 1900), ("TRIM", 1500))
    ]
    made += [parameter(f"INS_GYR{i}OFFS_{axis}", FLOAT, i / 64, 0) for i in range(1, 4) for axis in "XYZ"]
    made += [
        parameter("BATT_MONITOR", INT8, 4, 0),
        parameter("BATT_CAPACITY", INT32, 5200, 3300),
        parameter("BATT_LOW_VOLT", FLOAT, 10.5, 10.5),
        parameter("WPNAV_SPEED", FLOAT, 1000, 1000),
        parameter("RTL_ALT", INT32, 1500, 1500),
        parameter("LOG_BITMASK", INT32, 176126, 176126),
        parameter("ATC_RAT_PIT_P", FLOAT, 0.135, 0.135),
        parameter("GRIP_ENABLE", INT8, 0, 0),
        parameter("GRIP_GRAB", INT16, 1900, 1900, needs="GRIP_ENABLE"),
        parameter("BARO1_GND_PRESS", FLOAT, 94502.5, 0, drift=0.25),
        parameter("STAT_BOOTCNT", INT16, 7, 0),
        parameter("STAT_RUNTIME", INT32, 3600, 0, drift=1),
    ]
    return made


def _px4_parameters() -> list[Parameter]:
    """Return some of PX4's, which has integers of 32 bits and floats only."""
    made = [
        parameter("BAT1_CAPACITY", FLOAT, -1, -1),
        parameter("BAT1_N_CELLS", INT32, 4, 0),
        parameter("CAL_BARO0_ID", INT32, 6620172, 0),
        parameter("CAL_BARO0_OFF", FLOAT, 2.4375, 0, drift=0.0625),
    ]
    made += [parameter(f"CAL_GYRO{i}_{axis}OFF", FLOAT, i / 64, 0) for i in range(3) for axis in "XYZ"]
    made += [
        parameter("COM_FLIGHT_UUID", INT32, 12, 0),
        parameter("EKF2_ABL_LIM", FLOAT, 0.4, 0.4),
        parameter("LND_FLIGHT_T_LO", INT32, 3600, 0, drift=1),
        parameter("MC_PITCHRATE_P", FLOAT, 0.15, 0.15),
        parameter("MC_ROLLRATE_P", FLOAT, 0.135, 0.15),
        parameter("MIS_TAKEOFF_ALT", FLOAT, 2.5, 2.5),
        parameter("MPC_XY_VEL_MAX", FLOAT, 12, 12),
        parameter("NAV_ACC_RAD", FLOAT, 10, 10),
    ]
    made += [
        parameter(f"PWM_MAIN_{kind}{i}", INT32, 1000, 1000) for kind in ("DIS", "MIN") for i in range(1, 9)
    ]
    made += [parameter("SDLOG_MODE", INT32, 0, 0), parameter("SYS_AUTOSTART", INT32, 10040, 0)]
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


def _is_parameter_file(name: bytes) -> bool:
    return name.partition(b"?")[0] == b"param.pck"


class VirtualTrees:
    """The trees of one vehicle.

    trees: their names. exact: claimed sizes are right, and the server parses an upload of parameters as it
    arrives (PX4 of 2026). says_so: closing a refused upload fails (ArduPilot since mid-2025). clock: the
    server's.
    """

    def __init__(
        self,
        trees: Sequence[bytes] = TREES,
        *,
        exact: bool = False,
        says_so: bool = False,
        table: Table | None = None,
        sys_files: Mapping[bytes, bytes] | None = None,
        romfs: Mapping[bytes, bytes] | None = None,
    ) -> None:
        self._exact = exact
        self._says_so = says_so
        self.missions = Missions(says_so=says_so)
        self.clock: Callable[[], float] = lambda: 0.0
        made = _px4_parameters() if exact else _default_parameters()
        self.table = table if table is not None else Table(made)
        self.sys_files = dict(sys_files) if sys_files is not None else _default_sys()
        self.romfs = dict(romfs) if romfs is not None else _default_romfs()
        self._open = dict.fromkeys(trees, 0)
        self._leaked_listings = 0

    def reboot(self) -> None:
        """Forget open handles and leaked directory slots."""
        self._open = dict.fromkeys(self._open, 0)
        self._leaked_listings = 0

    def owns(self, path: bytes) -> bool:
        """Return whether the path is in one of these trees, with or without a leading slash."""
        tree = path.removeprefix(b"/").partition(b"/")[0]
        return tree in self._open

    def roots(self) -> list[bytes]:
        """Return the trees that a listing of `/` shows."""
        return [tree for tree in (b"@ROMFS", b"@SYS") if tree in self._open]

    def entries(self, path: bytes) -> list[TreeEntry]:
        """List @SYS or a directory of @ROMFS; ENOENT for the rest.

        Listing a missing @ROMFS directory leaks one of four slots; then every @ROMFS listing is ENFILE.
        """
        tree, name = self._split(path)
        if tree == b"@SYS" and not name:
            return [TreeEntry(file, self.stat(b"@SYS/" + file)) for file in self.sys_files]
        if tree == b"@ROMFS":
            return self._romfs_entries(name)
        raise fail(errno.ENOENT, path)

    def _romfs_entries(self, name: bytes) -> list[TreeEntry]:
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
        return [TreeEntry(file, stat) for file, stat in found.items()]

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
            return 12 * len(self.table.visible(self.clock()))
        return _SYS_CLAIM if tree == b"@SYS" else _MISSION_CLAIM

    def content(self, path: bytes, block: int) -> bytes:
        """Return what a download in blocks of `block` bytes yields."""
        return self._content(*self._split(path), block)

    def _content(self, tree: bytes, name: bytes, block: int) -> bytes:
        if tree == b"@PARAM" and _is_parameter_file(name):
            return self.table.download(selection(name.partition(b"?")[2]), block, self.clock())
        if tree == b"@MISSION" and name in NAMES:
            return self.missions.packed(name)
        files = {b"@SYS": self.sys_files, b"@ROMFS": self.romfs}.get(tree, {})
        if name not in files:
            raise fail(errno.ENOENT, name)
        return files[name]

    def open(self, path: bytes, *, write: bool) -> OpenFile:
        """Open a file; at most four at a time in each tree (ENFILE)."""
        tree, name = self._split(path)
        if not name:
            raise fail(errno.ENOENT, path)
        if write and tree in (b"@SYS", b"@ROMFS"):
            raise fail(errno.EROFS, path)
        size = 0 if write and self._exact else self._claimed_size(tree, name)
        if not write and not self._content(tree, name, 239):
            raise fail(errno.ENOENT, path)  # listed, although it cannot be opened (AP_Filesystem_Sys::open)
        if self._open[tree] >= MAX_HANDLES:
            raise fail(errno.ENFILE, path)
        self._open[tree] += 1
        if tree == b"@PARAM":
            return self._open_parameters(name, size, write=write)
        if tree == b"@MISSION":
            closed = partial(self._closed, tree)
            return MissionFile(self.missions, name, size, write=write, on_close=closed)
        return VirtualFile(self._content(tree, name, 239), size, on_close=lambda: self._closed(tree))

    def _open_parameters(self, name: bytes, size: int, *, write: bool) -> ParameterFile:
        upload: ParameterUpload | None = None
        if write and self._exact:
            upload = StrictUpload(self.table)
        elif write:
            upload = LenientUpload(self.table, says_so=self._says_so)
        return ParameterFile(
            self.table,
            selection(name.partition(b"?")[2]),
            lambda: self.clock(),
            claimed=size,
            live=not self._exact,
            upload=upload,
            on_close=lambda: self._closed(b"@PARAM"),
        )

    def _closed(self, tree: bytes) -> None:
        self._open[tree] = max(0, self._open[tree] - 1)

    @staticmethod
    def _split(path: bytes) -> tuple[bytes, bytes]:
        tree, _, name = path.removeprefix(b"/").partition(b"/")
        return tree, name.strip(b"/")


class VirtualFile(ClaimedFile):
    """An open virtual file. Written bytes are dropped."""

    def __init__(self, content: bytes, claimed: int, *, on_close: Callable[[], None]) -> None:
        super().__init__(claimed, on_close)
        self._content = content

    def read(self, offset: int, size: int) -> bytes:
        """See OpenFile."""
        return self._content[offset : offset + size]

    def write(self, offset: int, data: bytes) -> int:
        """See OpenFile."""
        return len(data)
