"""A vehicle's files for trio programs: `async with mavftpfs.trio.connect(SOURCE) as drone`. Layer: api."""

from mavftpfs.api.errors import NotDelivered, UsageError
from mavftpfs.api.vehicle import Drone, Entry, connect

__all__ = ["Drone", "Entry", "NotDelivered", "UsageError", "connect"]
