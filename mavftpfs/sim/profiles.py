"""Firmware profiles: the properties of each simulated server, as data. Layer: sim; pure.

Sources of the numbers: servers.md, PX4 `mavlink_ftp.cpp`, ArduPilot
`GCS_FTP.cpp`, MAVSDK `mavlink_ftp_server.cpp`, and the recordings in tests/data.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

from mavftpfs.protocol.payload import MAX_DATA

TREES = (b"@SYS", b"@ROMFS", b"@PARAM", b"@MISSION")
"""The `@` directories of an ArduPilot."""


class Family(Enum):
    """The project whose code the server runs."""

    PX4 = "px4"
    ARDUPILOT = "ardupilot"
    MAVSDK = "mavsdk"


class Storage(Enum):
    """The filesystem of the card, as far as clients notice it."""

    POSIX = "posix"
    NUTTX_FAT = "nuttx-fat"
    FATFS = "fatfs"
    LITTLEFS = "littlefs"


@dataclass(frozen=True, slots=True)
class Profile:
    """The differences between servers. Times in seconds, sizes in bytes, rates in bytes per second. A family
    ignores the fields that it does not need.
    """

    name: str
    family: Family
    about: str = ""
    """The simulated firmware, for `sim --help`."""
    version: int = 0
    """The firmware's version as AUTOPILOT_VERSION has it; the last byte is 255 in releases."""
    log_place: str = "log"
    """Where logs lie on the card."""
    storage: Storage = Storage.POSIX
    case_fold: bool = False
    """The card ignores the case of names (FatFs)."""
    newlib_errnos: bool = False
    """ENOTEMPTY is 90, ENAMETOOLONG 91, ENOSYS 88, ELOOP 92 (servers.md 12)."""

    # Requests
    list_with_time: bool = False
    """The server answers opcode 16; otherwise that is an unknown opcode."""
    unknown_code: int = 7
    """NAK code for an unknown opcode (ArduPilot before mid-2026: 1)."""
    virtual_trees: tuple[bytes, ...] = ()
    """The `@` trees that exist (ArduPilot, PX4 of 2026)."""
    double_nul: bool = False
    """Listing entries end in two zero bytes (ArduPilot before mid-2026)."""
    drop_long_names: bool = False
    """A listing leaves out a name that is too long for a page. False: the listing ends there (ArduPilot)."""
    root_omits_files: bool = False
    """Listing `/` shows no plain files, listing `.` does (ArduPilot SITL, generation A)."""
    counted_path_nul: bool = True
    """A path may count its trailing NUL in `size` (ArduPilot since mid-2025)."""
    path_limit: int = 238
    """The server cuts longer paths silently (PX4, ArduPilot)."""

    longest_reply: int = MAX_DATA
    """Data bytes of a reply to a read or a burst at most. PX4 may send less over a radio (servers.md 7)."""

    # Sessions
    sessions: int = 1
    idle_close: float | None = None
    """PX4: 10; ArduPilot generation B: 20 when the queue is idle."""
    write_only_truncates: bool = False
    """OpenFileWO cuts the file to nothing (MAVSDK)."""
    write_only_creates: bool = True
    """OpenFileWO makes a missing file (PX4, ArduPilot generation B)."""

    # PX4
    of_2026: bool = False
    """PX4 of September 2026. An open closes any other client's file; earlier versions refuse it. The server
    repeats an answer only to the client that asked, and without stray bytes. A path with `..` in it is
    protected. Bursts and writes with no file open are InvalidSession, and reading no bytes is EOF; earlier,
    session 0 is enough. The scratch buffer is not freed after 2 s, and the whitelist for writes looks at the
    open file's path. Opcode 16 lists directories as a bare D<name>. @PARAM/param.pck has its right size."""
    logs: bytes = b""
    """The directory that `@MAV_LOG` names."""
    writable_root: bytes = b""
    """Writes must start with this; the check looks at a scratch buffer (servers.md 8)."""

    # Timing
    request_cost: float = 0.0
    """Time each request takes, during which the server does nothing else."""
    stall_chance: float = 0.0
    """Share of reads and writes that hit a slow SD card."""
    stall: tuple[float, float] = (0.05, 0.3)
    """Shortest and longest such stall."""
    crc_rate: float = 100e6
    """Bytes per second that CalcFileCRC32 reads."""
    readdir_cost: float = 0.0
    """Time per entry read, also those before the page's offset."""
    rx_buffer: int = 212_992
    """Frame bytes that may wait while the server is busy; more are lost (PX4)."""
    tx_buffer: int = 15_000
    """Bytes that a burst may send per tick (PX4); the link may have room for less."""

    # Bursts
    burst_packets: int = 0
    """Packets in one burst (ArduPilot, MAVSDK). PX4 counts bytes instead."""
    burst_interval: float = 0.0
    """Time per burst packet at best."""
    short_packet_completes: bool = False
    """burst_complete is set on the short last packet and on the NAK. False: only on the NAK (ArduPilot)."""
    exact_eof_offset: bool = True
    """False: the EOF NAK's offset is a packet too small where sizes divide (ArduPilot generation A)."""


_PX4 = Profile(
    name="px4",
    family=Family.PX4,
    about="PX4 1.16 on Linux: one session, no times, no parameters",
    version=0x011000FF,
    log_place="fs/microsd/log",
    path_limit=237,
    idle_close=10.0,
)
_ARDUPILOT = Profile(
    name="ardupilot",
    family=Family.ARDUPILOT,
    about="ArduPilot 4.6: one session, no times; @SYS, @PARAM, @MISSION",
    version=0x040603FF,
    log_place="APM/LOGS",
    unknown_code=1,
    virtual_trees=TREES,
    double_nul=True,
    counted_path_nul=False,
    write_only_creates=False,
    burst_packets=500,
    burst_interval=0.0056,
    short_packet_completes=True,
    exact_eof_offset=False,
)
_ARDUPILOT5 = Profile(
    name="ardupilot5",
    family=Family.ARDUPILOT,
    about="ArduPilot 4.7-dev on a FAT card: five sessions, times",
    version=0x04070000,
    log_place="APM/LOGS",
    storage=Storage.FATFS,
    case_fold=True,
    newlib_errnos=True,
    list_with_time=True,
    virtual_trees=TREES,
    drop_long_names=True,
    sessions=5,
    idle_close=20.0,
    crc_rate=400e3,
    burst_packets=2000,
    burst_interval=0.0056,
)
_MAVSDK = Profile(
    name="mavsdk",
    family=Family.MAVSDK,
    about="MAVSDK's own server: one session, times, no size of the card",
    list_with_time=True,
    path_limit=239,
    write_only_truncates=True,
    write_only_creates=False,
    burst_packets=150,
    burst_interval=0.00206,
)

_ALL = (
    _PX4,
    replace(
        _PX4,
        name="px4-nuttx",
        about="PX4 1.16 on a board: a FAT card that pauses, /fs/microsd",
        storage=Storage.NUTTX_FAT,
        path_limit=238,
        writable_root=b"/fs/microsd/",
        request_cost=0.0005,
        stall_chance=0.002,
        crc_rate=600e3,
        readdir_cost=0.0002,
        rx_buffer=1500,
        tx_buffer=1500,
    ),
    replace(
        _PX4,
        name="px4-2026",
        about="PX4 of September 2026: times, @PARAM, and /log as #/@MAV_LOG",
        version=0x01120000,
        log_place="log",
        idle_close=30.0,
        of_2026=True,
        logs=b"/log",
        list_with_time=True,
        virtual_trees=(b"@PARAM",),
    ),
    _ARDUPILOT,
    _ARDUPILOT5,
    replace(
        _ARDUPILOT5,
        name="littlefs",
        about="ArduPilot 4.7-dev on LittleFS, which cannot rename",
        storage=Storage.LITTLEFS,
        case_fold=False,
        list_with_time=False,
        unknown_code=1,
        double_nul=True,
        drop_long_names=False,
        short_packet_completes=True,
        exact_eof_offset=False,
        crc_rate=150e3,
    ),
    _MAVSDK,
)

PROFILES: dict[str, Profile] = {profile.name: profile for profile in _ALL}
