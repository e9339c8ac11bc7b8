"""Opens the link that a SOURCE names. Layer: link."""

from __future__ import annotations

from contextlib import AbstractAsyncContextManager

from mavftpfs.link.base import Link
from mavftpfs.link.serial import open_serial
from mavftpfs.link.tcp import open_tcp, open_tcp_server
from mavftpfs.link.udp import open_udp
from mavftpfs.link.uri import LinkKind, LinkSpec


def open_link(
    spec: LinkSpec, *, patient: bool = False, source_port: int = 0
) -> AbstractAsyncContextManager[Link]:
    """Return an async context manager that opens the link, runs its helper task and closes it.

    patient: a TCP peer or a serial port may appear later. source_port: the preferred local port of `udpout`.

    Entering it raises:
        LinkClosed: the link cannot be opened; the text is one line that says what to do.
    """
    match spec.kind:
        case LinkKind.UDP_IN | LinkKind.UDP_OUT:
            return open_udp(spec, source_port)
        case LinkKind.TCP_OUT:
            return open_tcp(spec, patient=patient)
        case LinkKind.TCP_IN:
            return open_tcp_server(spec)
        case LinkKind.SERIAL:
            return open_serial(spec, patient=patient)
