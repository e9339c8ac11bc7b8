"""Serial links: USB ports, telemetry radios, ptys. Layer: link; the only importer of pyserial.

pyserial opens the port (settings, exclusive lock); afterwards this module uses the plain descriptor. A port
that vanishes (unplugged, vehicle rebooted) is opened again when it returns under the same name.
"""

from __future__ import annotations

import termios
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import serial
import trio

from mavftpfs.link.base import Pipe, background
from mavftpfs.link.stream import Opened, StreamLink
from mavftpfs.link.uri import LinkSpec, cannot_open

_LEAST_OUTBOX = 4096


@asynccontextmanager
async def open_serial(spec: LinkSpec, *, patient: bool = False) -> AsyncIterator[StreamLink]:
    """Open a serial port, and again whenever it vanishes.

    patient: return at once, and open the port when it can be opened.

    Raises:
        LinkClosed: no such port, no permission, or in use.
    """

    async def reopen() -> Opened:
        return await trio.to_thread.run_sync(_open_port, spec), None

    try:
        pipe = None if patient else (await reopen())[0]
    except OSError as exc:
        raise cannot_open(spec, exc) from exc
    # About a second of the line, because the answer to a request that waits longer arrives too late anyway.
    limit = max(_LEAST_OUTBOX, spec.baud // 10)
    link = StreamLink(spec.description, reopen, pipe, is_serial=True, outbox_limit=limit)
    async with background(link.run, link.aclose):
        yield link


def _open_port(spec: LinkSpec) -> Pipe:
    """Open the port for non-blocking use.

    Raises:
        OSError: also for settings that the port refuses.
    """
    try:
        port = serial.Serial(spec.device, spec.baud, timeout=0, exclusive=True)
    except ValueError as exc:
        raise OSError(0, f"the port refuses {spec.baud} baud: {exc}") from exc
    except serial.SerialException as exc:
        if exc.errno is None and isinstance(exc.__context__, termios.error):
            raise OSError(*exc.__context__.args) from exc
        raise
    try:
        _make_reads_tell_empty_from_gone(port.fileno())
    except termios.error as exc:
        port.close()
        raise OSError(*exc.args) from exc
    result: Pipe = port
    return result


def _make_reads_tell_empty_from_gone(fd: int) -> None:
    # With pyserial's VMIN 0 a read returns b"" both for an empty port and for one that is gone.
    attributes = termios.tcgetattr(fd)
    attributes[6][termios.VMIN] = 1
    attributes[6][termios.VTIME] = 0
    termios.tcsetattr(fd, termios.TCSANOW, attributes)
