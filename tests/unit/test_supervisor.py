"""The mount of all vehicles: what becomes of a vehicle whose own mount cannot even be started."""

from __future__ import annotations

from mavftpfs.link.uri import parse_source
from mavftpfs.mount.life import MountRequest
from mavftpfs.mount.members import Member, MemberState
from mavftpfs.mount.supervisor import Supervisor
from mavftpfs.shared.options import Options

SOURCE = "udpin:127.0.0.1:14550"


async def test_a_mount_that_cannot_be_started_has_failed_and_is_tried_again() -> None:
    request = MountRequest(SOURCE, parse_source(SOURCE), "/nowhere", Options())
    supervisor = Supervisor(request, lambda member: ["/does/not/exist"], lambda code, line: None)
    member = Member(1)
    member.start()
    await supervisor._keep_mounted(member)
    assert member.state is MemberState.FAILED
    assert "cannot be started" in member.problem
