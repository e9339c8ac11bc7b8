"""SOURCE parsed, and the reasons why a link could not be opened. Layer: link; pure.

    udpin:0.0.0.0:14550  udp:...  udpout:host:port  tcp:host:port  tcpin:host:port  /dev/ttyUSB0,57600
    udpin://0.0.0.0:14550  udpout://  tcp://  tcpout://  tcpin://  serial:///dev/ttyUSB0:57600

IPv6 addresses stand in brackets. `#/remote/dir` at the end names the directory to mount.
"""

from __future__ import annotations

import errno
from dataclasses import dataclass, replace
from enum import Enum

from mavftpfs.shared.errors import LinkClosed, UsageError
from mavftpfs.shared.model import ROOT, normalise

DEFAULT_BAUD = 57600
"""Telemetry radios; USB ports ignore it."""
DEFAULT_UDP_PORT = 14550
DEFAULT_TCP_PORT = 5760
LOOPBACK = "127.0.0.1"

_EXAMPLES = "udpin:0.0.0.0:14550, tcp:192.168.1.10:5760 or /dev/ttyUSB0,57600"


class LinkKind(Enum):
    """Which end begins, and over which transport."""

    UDP_IN = "udpin"
    UDP_OUT = "udpout"
    TCP_OUT = "tcp"
    TCP_IN = "tcpin"
    SERIAL = "serial"

    @property
    def listens(self) -> bool:
        """Whether this end waits for the other one to begin."""
        return self in (LinkKind.UDP_IN, LinkKind.TCP_IN)

    @property
    def is_udp(self) -> bool:
        """Whether the link carries datagrams; all others are streams."""
        return self in (LinkKind.UDP_IN, LinkKind.UDP_OUT)


@dataclass(frozen=True, slots=True)
class LinkSpec:
    """A parsed SOURCE. host and port for UDP and TCP (IPv6 without brackets), device and baud for serial;
    subtree: the normalised remote directory to mount."""

    kind: LinkKind
    host: str = ""
    port: int = 0
    device: str = ""
    baud: int = DEFAULT_BAUD
    subtree: bytes = ROOT

    @property
    def description(self) -> str:
        """SOURCE in pymavlink's spelling, without the subtree."""
        if self.kind is LinkKind.SERIAL:
            return f"{self.device},{self.baud}"
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{self.kind.value}:{host}:{self.port}"


_KINDS = {
    "udp": LinkKind.UDP_IN,  # as in pymavlink: `udp:` listens
    "udpin": LinkKind.UDP_IN,
    "udpout": LinkKind.UDP_OUT,
    "tcp": LinkKind.TCP_OUT,
    "tcpout": LinkKind.TCP_OUT,
    "tcpin": LinkKind.TCP_IN,
    "serial": LinkKind.SERIAL,
}


def parse_source(text: str) -> LinkSpec:
    """Return the link that `text` names.

    Raises:
        UsageError: the text is wrong; the message is one line with a right example.
    """
    require_expanded(text)
    source, mark, subtree_text = text.partition("#")
    subtree = _parse_subtree(subtree_text, source) if mark else ROOT
    scheme, colon, rest = source.partition(":")
    if not source:
        raise UsageError(f"SOURCE is empty; write for example {_EXAMPLES}")
    if source.startswith("/") or not colon:
        return _parse_serial(source, source, ",", subtree)
    kind = _KINDS.get(scheme.lower())
    if kind is None:
        raise UsageError(f"SOURCE {source!r}: unknown kind of link {scheme!r}; write for example {_EXAMPLES}")
    if rest.startswith("//"):
        rest = rest[2:]
        if kind is not LinkKind.SERIAL:
            rest = rest.rstrip("/")
    if kind is LinkKind.SERIAL:
        return _parse_serial(rest, source, "," if "," in rest else ":", subtree)
    host, port = _parse_host_port(rest, source, kind)
    return LinkSpec(kind, host=host, port=port, subtree=subtree)


def parse_endpoint(text: str) -> LinkSpec:
    """Return the link of an endpoint of `forward=`: as a SOURCE, except that a listening endpoint without an
    address serves this computer only.

    Raises:
        UsageError: as parse_source; or the endpoint names a directory.
    """
    spec = parse_source(text)
    if spec.subtree != ROOT:
        raise UsageError(f"{text!r} carries frames, so it cannot name a directory; leave out '#...'")
    rest = text.partition(":")[2].removeprefix("//")
    if spec.kind.listens and rest.startswith(":"):
        return replace(spec, host=LOOPBACK)
    return spec


def require_expanded(source: str) -> None:
    """Check that the shell has expanded a `~` at the beginning of SOURCE.

    Raises:
        UsageError: SOURCE begins with `~`.
    """
    if source.startswith("~/"):
        raise UsageError(f"SOURCE {source!r}: the shell does not expand ~ in quotes; quote only the pattern")


def _parse_subtree(text: str, source: str) -> bytes:
    path = text.encode("utf-8", "surrogateescape")
    if not path.startswith((b"/", b"@")):
        raise UsageError(
            f"remote directory {text!r} must begin with '/'; write for example {source}#/fs/microsd"
        )
    if b".." in path.split(b"/") or b"\0" in path:
        raise UsageError(
            f"remote directory {text!r} may not hold '..'; write for example {source}#/fs/microsd"
        )
    return normalise(path)


def _parse_serial(text: str, source: str, separator: str, subtree: bytes) -> LinkSpec:
    device, mark, baud_text = text.rpartition(separator)
    if not mark:
        device, baud_text = text, str(DEFAULT_BAUD)
    if not device.startswith("/"):
        raise UsageError(
            f"SOURCE {source!r} is neither a device path nor a link; write for example {_EXAMPLES}"
        )
    baud = _number(baud_text)
    if baud is None or not 50 <= baud <= 12_000_000:
        raise UsageError(
            f"SOURCE {source!r}: {baud_text!r} is not a baud rate; write for example {device},57600"
        )
    return LinkSpec(LinkKind.SERIAL, device=device, baud=baud, subtree=subtree)


def _parse_host_port(text: str, source: str, kind: LinkKind) -> tuple[str, int]:
    default = DEFAULT_UDP_PORT if kind.is_udp else DEFAULT_TCP_PORT
    example = f"{kind.value}:{'0.0.0.0' if kind.listens else '192.168.1.10'}:{default}"
    if text.startswith("["):
        host, mark, port_text = text[1:].partition("]")
        if not mark or (port_text and not port_text.startswith(":")):
            raise UsageError(
                f"SOURCE {source!r}: bracket not closed; write for example {kind.value}:[::1]:{default}"
            )
        port_text = port_text[1:]
    else:
        host, _, port_text = text.partition(":")
        if ":" in port_text:
            raise UsageError(
                f"SOURCE {source!r}: write IPv6 in brackets, for example {kind.value}:[::1]:{default}"
            )
    if host.isdigit() and not port_text:
        raise UsageError(f"SOURCE {source!r}: a host comes before the port; write for example {example}")
    if not host and not kind.listens:
        raise UsageError(f"SOURCE {source!r} names no host; write for example {example}")
    if not port_text:
        shown = f"[{host}]" if ":" in host else host or "0.0.0.0"
        raise UsageError(f"SOURCE {source!r} names no port; write for example {kind.value}:{shown}:{default}")
    port = _number(port_text)
    if port is None or not 0 <= port <= 65535 or (port == 0 and not kind.listens):
        raise UsageError(f"SOURCE {source!r}: {port_text!r} is not a port; write for example {example}")
    return (host or "0.0.0.0", port)


def _number(text: str) -> int | None:
    # str.isdigit alone would let superscripts through to int().
    return int(text) if text.isascii() and text.isdigit() and len(text) <= 9 else None


# -- why a link could not be opened --------------------------------------------------------------------


def cannot_open(spec: LinkSpec, problem: OSError) -> LinkClosed:
    """Return the LinkClosed for an OSError from opening `spec`."""
    if spec.kind is LinkKind.SERIAL:
        gone = f"there is no {spec.device}; is the vehicle plugged in? (ls /dev/ttyACM* /dev/ttyUSB*)"
        taken = f"{spec.device} is in use by another program (a ground station? ModemManager?)"
        other = f"{spec.device} is not a serial port"
        remedy = "join its group (often: sudo usermod -aG dialout $USER) and log in again"
        reasons = dict.fromkeys((errno.ENOENT, errno.ENXIO, errno.ENODEV), gone)
        reasons |= dict.fromkeys((errno.EACCES, errno.EPERM), f"no permission for {spec.device}; {remedy}")
        reasons |= dict.fromkeys((errno.EBUSY, errno.EAGAIN, errno.EWOULDBLOCK), taken)
        reasons |= dict.fromkeys((errno.ENOTTY, errno.EISDIR), other)
    elif spec.kind.listens:
        taken = f"port {spec.port} is in use by another program (a ground station?);"
        not_ours = f"{spec.host} is not an address of this computer; 0.0.0.0 listens on all of them"
        refused = f"no permission to listen on port {spec.port}; ports below 1024 are root's"
        reasons = dict.fromkeys((errno.EACCES, errno.EPERM), refused)
        reasons[errno.EADDRINUSE] = f"{taken} close it, or have it forward to another port"
        reasons[errno.EADDRNOTAVAIL] = not_ours
    else:
        silent = f"{spec.host} does not answer; is its network joined?"
        reasons = dict.fromkeys((errno.ETIMEDOUT, errno.EHOSTUNREACH, errno.ENETUNREACH), silent)
        reasons[errno.ECONNREFUSED] = (
            f"nothing listens on port {spec.port} of {spec.host}; is the vehicle or its bridge running?"
        )
    reason = reasons.get(problem.errno or 0, problem.strerror or str(problem))
    return LinkClosed(f"{spec.description}: {reason}")
