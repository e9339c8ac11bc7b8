"""The messages that a framer found."""

from __future__ import annotations

from collections.abc import Iterable

from mavftpfs.link.framing import Framer
from mavftpfs.link.messages import FtpRun, Message


def feed(framer: Framer, data: bytes) -> list[Message]:
    """Feed a framer; return what it found, taken apart."""
    return singly(framer.feed(data))


def singly(messages: Iterable[Message]) -> list[Message]:
    """Return messages with runs of FTP frames taken apart."""
    single: list[Message] = []
    for message in messages:
        if isinstance(message, FtpRun):
            single += [message._replace(payloads=[payload]) for payload in message.payloads]
        else:
            single.append(message)
    return single
