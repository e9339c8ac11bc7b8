"""Closing a file that was written, and what that proves. Layer: session.

The answer to Terminate may be that of a vehicle that restarted before (ArduPilot ACKs what it does not know,
PX4's NAK 4 looks like a repetition's), and what it had in memory is gone then: at least the last sector. No
size tells that of a file that was changed in place. So where a restart cannot be ruled out, what was sent is
compared as if the session had been another client's.
"""

from __future__ import annotations

from mavftpfs.session.kit import Kit
from mavftpfs.session.opening import TERMINATE_LIMIT
from mavftpfs.session.upload import QueuedUpload
from mavftpfs.shared.errors import MavftpfsError


async def close_written(kit: Kit, upload: QueuedUpload, limit: float) -> bool:
    """Terminate; return whether what was ACKed counts as written.

    Raises:
        As SessionHolder.close.
    """
    vehicle = kit.vehicle
    heard_at, reboots = kit.driver.last_reply_at, vehicle.reboots
    ours = await kit.holder.close(limit)
    away = vehicle.identity.away_since(heard_at, kit.clock())
    upload.usurped |= away and not upload.create
    return ours and vehicle.reboots == reboots


async def close_refused(kit: Kit, upload: QueuedUpload) -> bool:
    """Do the same, if its file is open, after a refusal that is reported: another failure is no news."""
    session = kit.holder.session  # None where it failed before it got it
    if session is None or not session.writing or session.path != upload.path:
        return False
    try:
        return await close_written(kit, upload, TERMINATE_LIMIT)
    except MavftpfsError:
        return False
