"""What each command costs, exactly, on each server; tests/mount/test_requests.py holds it.

Terminate and verification are included; nothing is lost on the way.
"""

from __future__ import annotations

PROFILES = ("px4", "px4-nuttx", "ardupilot", "ardupilot5", "mavsdk")
MOUNT = "mount"
SAVE = "list 2, create 1, write 1, close 1, crc 1"
SAVE_NEW = "list 2, look 1, create 1, write 1, close 1, crc 1"
EXACT = {
    MOUNT: "list 3",  # one of them tries opcode 16
    "first append": "list 6, open 3, open-wo 3, create 2, write 2, close 8, rename 2, remove 1,"
    " truncate 1; 5 B",
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
    # A new file is looked for right before it is made, unless its directory was listed a moment ago.
    "echo > new": f"{SAVE_NEW}; 2 B",
    "echo > old": f"{SAVE}, rename 1; 2 B",
    "echo >>": "list 4, open 1, open-wo 1, write 1, close 2; 2 B",  # compared before and after
    "touch new": "list 2, look 1, create 1, close 1",
    "touch old": "open 1, close 1",
    "mkdir": "mkdir 1",
    "mv": "rename 1",
    "rm": "remove 1",
    "rm -r": "list 2, remove 10, rmdir 1",
    "vim save": "list 2, open 1, create 1, read 2, write 2, close 2, crc 1, rename 1; 603 B",
    "nano save": "list 2, open 1, create 1, read 2, write 2, close 2, crc 1, rename 1; 606 B",
    # Sizes are compared by listing as long as that is as cheap as opening.
    "cp 10 files to it": "list 8, look 1, open 6, create 10, write 20, close 16, crc 10; 3000 B",
    "rsync unchanged": "0",
    # What is removed was looked up at most FREE_FOR ago: a server would take a directory as well.
    "git status again": "look 1, open 1, create 1, close 2, remove 1",  # its lock
}
REPLACED = "rename 2, remove 1"  # FAT does not rename over a file
REWRITTEN = "list 4, open 1, create 1, read 2, write 2, close 2, crc 1, rename 1; 602 B"
ELSEWHERE = {
    "px4-nuttx": {
        "first append": "list 6, open 2, open-wo 3, create 2, write 2, close 7, rename 2, remove 1; 5 B",
        "rm -r": "list 1, remove 10, rmdir 1",
    },
    "ardupilot": {
        MOUNT: "list 5",  # "/" shows no files, so "." is listed too
        "first append": "list 4, open 2, open-wo 3, create 2, write 2, close 6, rename 2, remove 1,"
        " truncate 1; 5 B",
    },
    "ardupilot5": {
        MOUNT: "list 4",
        "first append": "list 10, open 2, open-wo 3, create 2, write 2, close 7, rename 2, remove 2,"
        " truncate 1; 5 B",
        "echo > old": f"{SAVE}, {REPLACED}; 2 B",
        "rm -r": "list 1, remove 10, rmdir 1",
        "vim save": f"list 2, open 1, create 1, read 2, write 2, close 2, crc 1, {REPLACED}; 603 B",
        "nano save": f"list 2, open 1, create 1, read 2, write 2, close 2, crc 1, {REPLACED}; 606 B",
    },
    "mavsdk": {
        MOUNT: "list 2",
        "first append": REWRITTEN,  # opening for writing would empty the file
        "echo >>": REWRITTEN,
        "rm -r": "list 1, remove 10, rmdir 1",
    },
}
"""Where a server needs something else."""


SPARED = {"git status again": ["look 1, create 1, close 1, remove 1"]}
"""git removes the lock that it has just made, often before its size was looked at."""


def expected(profile: str, name: str) -> tuple[str, ...]:
    """Return what a command may cost there; the first is what it costs as a rule."""
    return (ELSEWHERE.get(profile, {}).get(name, EXACT[name]), *SPARED.get(name, ()))
