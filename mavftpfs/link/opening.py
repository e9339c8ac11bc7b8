"""Opens the link a SOURCE names. Layer: link."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractAsyncContextManager

from mavftpfs.link.base import Link
from mavftpfs.link.serial import open_serial
from mavftpfs.link.tcp import open_tcp, open_tcp_server
from mavftpfs.link.udp import open_udp
from mavftpfs.link.uri import LinkKind, LinkSpec


def open_link(
    spec: LinkSpec, inherited: Sequence[int] = (), *, patient: bool = False
) -> AbstractAsyncContextManager[Link]:
    """Return an async context manager that opens the link, runs its helper task and closes it.

    inherited: descriptors of a link that another process had open (`Link.descriptors`); it goes on with them.
    patient: a TCP peer may come later.

    Entering it raises:
        LinkClosed: it cannot be opened; the text is one line that says what to do.
    """
    match spec.kind:
        case LinkKind.UDP_IN | LinkKind.UDP_OUT:
            return open_udp(spec, inherited)
        case LinkKind.TCP_OUT:
            return open_tcp(spec, inherited, patient=patient)
        case LinkKind.TCP_IN:
            return open_tcp_server(spec, inherited)
        case LinkKind.SERIAL:
            return open_serial(spec, inherited)
