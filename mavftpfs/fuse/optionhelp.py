"""What each mount option is for, in a line: for --help. Layer: fuse; pure. docs/guide.md has more."""

from __future__ import annotations

from mavftpfs.fuse.options import option_names

HELP: dict[str, str] = {
    "ro": "nothing is changed",
    "rw": "the default",
    "allow_other": "other users may see it (permissions apply)",
    "auto_unmount": "unmount when this process dies",
    "force": "change files that are seen to grow, too",
    "inplace": "replace files in place where the card cannot rename",
    "uid=": "whose the files are: you",
    "gid=": "whose group's: yours",
    "umask=": "octal; your umask",
    "fmask=": "umask of files only",
    "dmask=": "umask of directories only",
    "fsname=": "name in the table of mounts: SOURCE",
    "root=": "mount this directory of the vehicle: /",
    "target_system=": "which vehicle; 0: the first autopilot heard",
    "target_component=": "which part of it; 0: the first heard",
    "source_system=": "who we are on the link: 254",
    "source_component=": "and which part: 191",
    "heartbeat=": "what we say we are: onboard, gcs or none",
    "baud=": "of a serial line: 57600",
    "signing_key=": "file with the key of MAVLink 2 signing, mode 0600",
    "dir_timeout=": "seconds that a listing is kept: 20, longer if it is slow",
    "attr_timeout=": "seconds that the kernel keeps attributes: 1",
    "negative_timeout=": "seconds that it keeps absent names: 2",
    "cache_size=": "memory for file data: 64M",
    "cache_dir=": "keep what was read for the next mount there",
    "dirty_max=": "memory for what is not on the card yet: auto",
    "spool_max=": "local disk for what is not on the card yet: 1G",
    "rmw_max=": "largest file sent again whole for a changed part: 64M",
    "op_deadline=": "seconds without progress until an error: 30",
    "connect_timeout=": "seconds for the first heartbeat and listing: 30",
    "read_mode=": "window or burst",
    "chunk=": "bytes of a file in a packet, 16 to 239: auto",
    "window=": "requests in flight at most: auto",
    "bwlimit=": "bytes per second that we may cause on the link",
    "verify=": "written files: auto (size, and CRC32), size, crc, none",
    "verify_max=": "largest file whose CRC32 is asked for by auto: 4M",
    "when_armed=": "an armed vehicle is read-only: ro, or ok",
    "local=": "names that never reach the card; +PATTERN adds to them",
    "log_file=": "log there, not to syslog",
    "trace=": "every request and reply as a line of JSON there",
    "tlog=": "raw MAVLink log there",
}
"""Option as `option_names` has it -> what it does, with its default."""


def option_help() -> list[str]:
    """Return a line for each option."""
    return [f"  {name:<19}{HELP[name]}" for name in option_names()]
