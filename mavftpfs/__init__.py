"""mavftpfs mounts a drone's files, served over MAVLink FTP, as a local directory.

For Python programs: `mavftpfs.connect(SOURCE)`.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mavftpfs.api.drone import Drone, Entry, NotDelivered, UsageError, connect

__version__ = "1.0.0"

__all__ = ["Drone", "Entry", "NotDelivered", "UsageError", "__version__", "connect"]


def __getattr__(name: str) -> object:
    """Load the library when it is used first, because the program `mavftpfs` must start quickly."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from mavftpfs.api import drone

    return getattr(drone, name)
