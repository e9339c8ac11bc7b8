"""What each command costs, exactly, on each server; tests/mount/test_requests.py holds it.

Terminate and verification are included; nothing is lost on the way.
"""

from __future__ import annotations

PROFILES = ("px4", "px4-nuttx", "ardupilot", "ardupilot5", "mavsdk")
MOUNT = "mount"
EXACT = {
    MOUNT: "list 3",  # one of them tries opcode 16
    "first append": "open 1, create 1, read 2, write 2, close 2, crc 2, rename 1; 602 B",
    "ls -l cold": "list 4",  # two directories; the second request of each tells that there is no more
    "ls -l cached": "0",
    "cat cold": "open 1, read 2, close 1; 300 B",
    "cat warm": "0",
    "stat known names": "0",
    "stat unknown names": "0",
    "find cold": "list 14",  # seven directories
    "find cached": "0",
    "cp 10 files from it": "open 10, read 20, close 10; 3000 B",
    "df": "0",
    "head of a big file": "open 1, read 69, close 1; 16384 B",  # what the kernel asks for
    "thumbnail of a big file": "open 1, read 107, close 1; 25152 B",
    # It is sent, and its CRC32 is compared; its name is opened, to see that it is free; a rename.
    "echo > new": "open 1, create 1, write 1, close 1, crc 1, rename 1; 2 B",
    "echo > old": "create 1, write 1, close 1, crc 1, rename 1; 2 B",
    # All of it is sent, and the old file is compared once more before it is replaced.
    "echo >>": "open 1, create 1, read 2, write 2, close 2, crc 2, rename 1; 602 B",
    "touch new": "open 2, create 1, close 2, rename 1",
    "touch old": "open 1, close 1",
    "mkdir": "mkdir 1",
    "mv": "rename 1",
    "rm": "remove 1",
    "rm -r": "list 2, remove 10, rmdir 1",
    "vim save": "open 1, create 1, read 2, write 2, close 2, crc 1, rename 1; 603 B",
    "nano save": "open 1, create 1, read 2, write 2, close 2, crc 1, rename 1; 606 B",
    "cp 10 files to it": "open 10, create 10, write 20, close 10, crc 10, rename 10; 3000 B",
    "rsync unchanged": "0",
    "git status again": "list 2, create 1, close 1, remove 1",  # its lock
}
REPLACED = "rename 2, remove 1"  # FAT does not rename over a file, and NuttX removes it first
TIMED = "list 2, open 1, create 1, read 2, write 2, close 2, crc 1"
"""Where listings tell times, one of them compares the old file."""

FAT = {
    "echo > old": f"create 1, write 1, close 1, crc 1, {REPLACED}; 2 B",
    "rm -r": "list 1, remove 10, rmdir 1",
    "vim save": f"open 1, create 1, read 2, write 2, close 2, crc 1, {REPLACED}; 603 B",
    "nano save": f"open 1, create 1, read 2, write 2, close 2, crc 1, {REPLACED}; 606 B",
}
ELSEWHERE = {
    "px4-nuttx": {
        **FAT,
        "first append": f"open 1, create 1, read 2, write 2, close 2, crc 2, {REPLACED}; 602 B",
        "echo >>": f"open 1, create 1, read 2, write 2, close 2, crc 2, {REPLACED}; 602 B",
    },
    "ardupilot": {MOUNT: "list 5"},  # "/" shows no files, so "." is listed too
    "ardupilot5": {
        **FAT,
        MOUNT: "list 4",
        # That it does not rename over a file is learnt, and the names are looked at after the refusal.
        "first append": "list 4, open 1, create 1, read 2, write 2, close 2, crc 1, rename 3, remove 1;"
        " 602 B",
        "echo >>": f"{TIMED}, {REPLACED}; 602 B",
    },
    "mavsdk": {
        MOUNT: "list 2",
        "first append": f"{TIMED}, rename 1; 602 B",
        "echo >>": f"{TIMED}, rename 1; 602 B",
        "rm -r": "list 1, remove 10, rmdir 1",
    },
}
"""Where a server needs something else."""


SPARED = {"git status again": ["list 2"]}
"""git removes the lock that it has just made, often before anything of it was sent."""


def expected(profile: str, name: str) -> tuple[str, ...]:
    """Return what a command may cost there; the first is what it costs as a rule."""
    return (ELSEWHERE.get(profile, {}).get(name, EXACT[name]), *SPARED.get(name, ()))
