"""What has a name before it is opened to be written. Layer: session.

A new file is to take nobody's place. And an upload in place closes its file when another one is wanted, or
nothing is there to be sent, and loses it with the link. What has the name when it is opened again may be
another file, and its time says nothing: what we wrote moved it. So after some absence a piece of what was
written is read back first.
"""

from __future__ import annotations

import errno

from mavftpfs.protocol.operations import Simple
from mavftpfs.protocol.payload import NakCode, Opcode
from mavftpfs.session.holder import SessionHolder
from mavftpfs.session.kit import Kit
from mavftpfs.session.upload import QueuedUpload
from mavftpfs.shared.errnos import errno_for
from mavftpfs.shared.errors import AlreadyExists, FtpNak, SessionLost

A_MOMENT = 0.5
"""Seconds for which it is taken to be the same: less than a turn of others, more than most listings."""

LOOKS = 2
"""Differing twice, since another client may have had the session meanwhile."""


async def require_free(holder: SessionHolder, path: bytes) -> None:
    """Find out by one request that CreateFile empties nothing, under no other spelling either.

    Raises:
        AlreadyExists. FtpNak: it is there perhaps.
    """
    try:
        await holder.open(path, Opcode.OPEN_FILE_RO)
    except FtpNak as nak:
        if errno_for(nak) != errno.ENOENT:
            raise
    else:
        await holder.close()
        raise AlreadyExists(f"{path!r} was made by somebody else in the meantime")


async def is_same(kit: Kit, upload: QueuedUpload) -> bool:
    """Return whether a file holds what was written of it, as far as that is known and in doubt.

    Raises:
        As SessionHolder.open and Driver.run.
    """
    if upload.create or upload.shared or upload.overwrites or kit.clock() - upload.left_at <= A_MOMENT:
        return True
    for _ in range(LOOKS):
        proof = upload.feed.proof
        if proof is None or await _holds(kit, upload.path, *proof):
            return True
    return upload.shared  # then it may have been another client's file that was read


async def _holds(kit: Kit, path: bytes, offset: int, expected: bytes) -> bool:
    expected = expected[: kit.write_chunks.size]  # longer frames may not pass
    session = await kit.holder.open(path, Opcode.OPEN_FILE_RO)
    operation = Simple(Opcode.READ_FILE, session=session.id, offset=offset, size=len(expected))
    try:
        await kit.driver.run(operation)
    except FtpNak as nak:
        if nak.code != NakCode.EOF:
            raise SessionLost(str(nak)) from nak
        return False
    data = operation.reply.data[: len(expected)]  # some servers send less than is asked for
    return bool(data) and expected.startswith(data)
