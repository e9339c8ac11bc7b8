"""Checks before a mount, with one line each, and unmounting. Layer: client; only the standard library.

Everything here is called before this program's mount exists, or from another process or a worker thread,
because a system call on the mount from its own event loop would wait for itself.
"""

from __future__ import annotations

import errno
import os
import re
import shutil
import stat
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from mavftpfs.shared.errors import MountFailed

FUSE_DEVICE = "/dev/fuse"
FUSE_SETTINGS = Path("/proc/sys/fs/fuse")
_CONTAINER = "a container needs --device /dev/fuse --cap-add SYS_ADMIN"
SUBTYPE = "mavftpfs"
"""The mount's type is fuse.mavftpfs, with the same word in fstab."""

OUR_TYPE = f"fuse.{SUBTYPE}"
MOUNT_TABLE = "/proc/self/mountinfo"
UNMOUNT_PATIENCE = 60.0
"""Seconds for an unmount, which waits for the last flush."""
XATTR_CRC32 = b"user.mavftp.crc32"
XATTR_STATUS = b"user.mavftpfs.status"
BUSY_PATIENCE = 1.0
"""Seconds for which a mount may look busy by chance: the kernel closes the files of a program a moment after
its parent learned of its end, and desktop services look at new files."""
_BUSY_PAUSE = 0.1


class DeadMount(MountFailed):
    """The mount's program is gone."""


def canonical(path: str) -> str:
    """Return the absolute path without symbolic links on the way; a trailing link is followed, too.

    The function looks only at the parents of the mountpoint, because the mountpoint itself may be a mount
    that hangs.
    """
    absolute = os.path.abspath(path)
    if absolute in mounts():
        return absolute
    parent, name = os.path.split(absolute)
    candidate = os.path.join(os.path.realpath(parent), name)
    return candidate if candidate in mounts() else os.path.realpath(candidate)


def enclosing_mount(path: str) -> tuple[str, str] | None:
    """Return (mountpoint, path on the mount or "") for a vehicle's mountpoint, or a path below one; otherwise
    None.

    The function follows symbolic links only if the path as it is spelled does not lead to a mount.
    """
    return _enclosing(os.path.abspath(path)) or _enclosing(canonical(path))


def _enclosing(path: str) -> tuple[str, str] | None:
    mountpoint, table = path, mounts()
    while mountpoint not in table and mountpoint != "/":
        mountpoint = os.path.dirname(mountpoint)
    mount = table.get(mountpoint)
    if mount is None or mount.type != OUR_TYPE:
        return None
    return mountpoint, mount.root.rstrip("/") + path[len(mountpoint) :]


def check_mountpoint(path: str, *, table: str = MOUNT_TABLE) -> None:
    """Check that a file system can be mounted on `path`.

    Raises:
        DeadMount: a mount that was killed is still there.
        MountFailed: any other reason; the text says what to do.
    """
    if is_dead(path, table=table):
        raise DeadMount(
            f"mountpoint {path} is a dead mount whose program is gone; run: mavftpfs umount {path}"
        )
    if is_ours(path, table=table):
        raise MountFailed(f"a vehicle is already mounted on {path}; run: mavftpfs umount {path}")
    try:
        mode = os.stat(path).st_mode
    except OSError as exc:
        raise MountFailed(_describe(path, exc)) from exc
    if not stat.S_ISDIR(mode):
        raise MountFailed(f"mountpoint {path} is not a directory")


def check_fuse(device: str = FUSE_DEVICE, *, uid: int | None = None) -> None:
    """Check that this machine and user can mount FUSE at all.

    Raises:
        MountFailed: they cannot; the text says what to do.
    """
    if not os.path.exists(device):
        raise MountFailed(f"there is no {device}; run: sudo modprobe fuse ({_CONTAINER})")
    if not os.access(device, os.R_OK | os.W_OK):  # fusermount3 opens the device with its user's rights
        raise MountFailed(f"{device} may not be opened; run: sudo chmod 666 {device} ({_CONTAINER})")
    if (os.getuid() if uid is None else uid) != 0 and shutil.which("fusermount3") is None:
        raise MountFailed("fusermount3 is missing, which mounts for users; run: sudo apt install fuse3")


def request_timeout(settings: Path = FUSE_SETTINGS) -> int | None:
    """Return the seconds after which this kernel ends a mount that does not answer; None if never."""
    limits = []
    for name in ("default_request_timeout", "max_request_timeout"):
        with suppress(OSError, ValueError):  # kernels before 6.15 have neither
            limits.append(int((settings / name).read_text()))
    return min(filter(None, limits), default=None)


def timeout_note() -> str:
    """Return a warning for people about the kernel's limit, or ""."""
    limit = request_timeout()
    if limit is None:
        return ""
    return (
        f"this kernel ends a mount that takes more than {limit} s for one request, as close() of a large "
        "file does on a slow link; unmount, and before you mount again run: "
        "sudo sysctl fs.fuse.default_request_timeout=0 fs.fuse.max_request_timeout=0"
    )


def why_not_mounted(path: str, said: str) -> str:
    """Return the message for people if libfuse or fusermount3 could not mount."""
    hint = f" ({_CONTAINER})" if "not permitted" in said else ""
    return f"cannot mount on {path}: {said}{hint}"


@dataclass(frozen=True, slots=True)
class Mounted:
    """An entry of the kernel's table of mounts.

    number: unique among the mounts that exist at one time. uid: of the user that mounted it, None if unknown.
    root: the directory of the file system that is visible there, for a bind mount of a part of it. others:
    all places where the same file system is mounted.
    """

    number: str
    type: str
    source: str
    uid: int | None
    root: str = "/"
    others: Sequence[str] = ()


def is_ours(path: str, *, table: str = MOUNT_TABLE) -> bool:
    """Return whether the topmost mount on `path` is one of mavftpfs."""
    mount = mounts(table).get(path)
    return mount is not None and mount.type == OUR_TYPE


def is_dead(path: str, *, table: str = MOUNT_TABLE) -> bool:
    """Return whether the mount on `path` is one of mavftpfs, and has lost its process."""
    if not is_ours(path, table=table):
        return False
    try:
        os.statvfs(path)  # the kernel may still know the answer to a stat
    except OSError as exc:
        return exc.errno in (errno.ENOTCONN, errno.ECONNABORTED)
    return False


def mounts(table: str = MOUNT_TABLE) -> dict[str, Mounted]:
    """Return mountpoint -> the mount on top of it, from the kernel's table."""
    found: dict[str, Mounted] = {}
    places: dict[str, list[str]] = {}
    for line in Path(table).read_text(errors="surrogateescape").splitlines():
        left, _, right = line.partition(" - ")
        columns = left.split(" ")
        if len(columns) > 4:
            number, _, device, root, place = [*columns[:3], *map(_unescape, columns[3:5])]
            kind, source, words = [*right.split(" "), "", ""][:3]
            uid = re.search(r"(?:^|,)user_id=(\d+)", words)
            others = places.setdefault(device, [])
            others.append(place)
            mounted = Mounted(number, kind, _unescape(source), int(uid[1]) if uid else None, root, others)
            found[place] = mounted
    return found


def vehicles_below(place: str) -> list[str]:
    """Return the mountpoints of a mount of all vehicles, one for each vehicle, sorted."""
    found = {path for path, mount in mounts().items() if mount.type == OUR_TYPE}
    return sorted(path for path in found if os.path.dirname(path) == place and _is_number(path))


def _is_number(path: str) -> bool:
    return bool(re.fullmatch("[0-9]{1,3}", os.path.basename(path)))


def unmount(path: str, *, lazy: bool = False) -> None:
    """Unmount, and wait for the end; with `lazy` even if programs use the mount. Another program may have
    unmounted it already.

    Raises:
        MountFailed: the mount is still there: busy, or for the reason that fusermount3 gave.
    """
    program = "fusermount3" if shutil.which("fusermount3") else "umount"
    words = [program, *(["-u"] if program == "fusermount3" else []), *(["-z"] if lazy else []), "--", path]
    if program == "umount" and lazy:
        words[1] = "-l"
    said = _said_by(words, path)
    for _ in range(round(BUSY_PATIENCE / _BUSY_PAUSE)):
        if said is None or not _is_busy(said):
            break
        time.sleep(_BUSY_PAUSE)
        said = _said_by(words, path)
    if said is not None and path in mounts():
        raise MountFailed(_describe_unmount(path, said))


def _said_by(words: list[str], path: str) -> str | None:
    """Return the complaint of a program that mounts or unmounts, None if it succeeded.

    Raises:
        MountFailed: the program cannot be started (it is missing, or no descriptors are left), or does not
            end.
    """
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=UNMOUNT_PATIENCE, check=False)
    except OSError as exc:
        command = " ".join(words)
        raise MountFailed(f"cannot start {words[0]} here: {exc.strerror}; run: {command}") from exc
    except subprocess.TimeoutExpired as exc:
        raise MountFailed(f"{words[0]} {path}: {exc}") from exc
    return done.stderr.strip() if done.returncode != 0 else None


def _is_busy(said: str) -> bool:
    return "busy" in said.lower()


@contextmanager
def stderr_of() -> Iterator[Callable[[], str]]:
    """Catch the output of C libraries and child programs on stderr during the body.

    Yields a function that returns its first line, without libfuse's `fuse: `.
    """
    saved = os.dup(2)
    with tempfile.TemporaryFile() as capture:

        def first_line() -> str:
            text = os.pread(capture.fileno(), 4096, 0).decode(errors="replace").strip()
            return text.partition("\n")[0].removeprefix("fuse: ")

        os.dup2(capture.fileno(), 2)
        try:
            yield first_line
        finally:
            os.dup2(saved, 2)
            os.close(saved)


def _describe(path: str, exc: OSError) -> str:
    if exc.errno == errno.ENOTCONN:
        return f"mountpoint {path} is a dead mount of another program; run: fusermount3 -u {path}"
    if exc.errno == errno.ENOENT:
        return f"mountpoint {path} does not exist; run: mkdir -p {path}"
    return f"mountpoint {path}: {os.strerror(exc.errno or errno.EIO)}"


def _describe_unmount(path: str, said: str) -> str:
    if _is_busy(said):
        return f"{path} is in use; close what has it open (fuser -vm {path}) and try again"
    mount = mounts().get(path)
    if mount is not None and mount.uid not in (None, os.getuid()) and os.getuid() != 0:
        return f"cannot unmount {path}: another user mounted it, and only uid {mount.uid} or root may"
    return f"cannot unmount {path}: {_first_line(said)}"


def _first_line(said: str) -> str:
    return said.splitlines()[0] if said else "no reason given"


def _unescape(text: str) -> str:
    """Undo the kernel's octal escapes of blanks and backslashes."""
    for code in ("\\040", "\\011", "\\012", "\\134"):
        text = text.replace(code, chr(int(code[1:], 8)))
    return text
