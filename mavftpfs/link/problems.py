"""Why a link could not be opened, in one line that says what to do. Layer: link; pure."""

from __future__ import annotations

import errno

from mavftpfs.link.uri import LinkKind, LinkSpec
from mavftpfs.shared.errors import LinkClosed


def cannot_open(spec: LinkSpec, problem: OSError) -> LinkClosed:
    """Return the error to raise for an OSError met while opening `spec`."""
    if spec.kind is LinkKind.SERIAL:
        reason = _serial_reason(spec, problem)
    elif spec.kind in (LinkKind.UDP_IN, LinkKind.TCP_IN):
        reason = _listen_reason(spec, problem)
    else:
        reason = _connect_reason(spec, problem)
    return LinkClosed(f"{spec.description}: {reason}")


def _listen_reason(spec: LinkSpec, problem: OSError) -> str:
    if problem.errno == errno.EADDRINUSE:
        return (
            f"port {spec.port} is in use by another program (a ground station?);"
            " close it, or have it forward to another port"
        )
    if problem.errno == errno.EADDRNOTAVAIL:
        return f"{spec.host} is not an address of this computer; 0.0.0.0 listens on all of them"
    if problem.errno in (errno.EACCES, errno.EPERM):
        return f"no permission to listen on port {spec.port}; ports below 1024 are root's"
    return _text(problem)


def _connect_reason(spec: LinkSpec, problem: OSError) -> str:
    if problem.errno == errno.ECONNREFUSED:
        return f"nothing listens on port {spec.port} of {spec.host}; is the vehicle or its bridge running?"
    if problem.errno in (errno.ETIMEDOUT, errno.EHOSTUNREACH, errno.ENETUNREACH):
        return f"{spec.host} does not answer; is its network joined?"
    return _text(problem)


def _serial_reason(spec: LinkSpec, problem: OSError) -> str:
    if problem.errno in (errno.ENOENT, errno.ENXIO, errno.ENODEV):
        return f"there is no {spec.device}; is the vehicle plugged in? (ls /dev/ttyACM* /dev/ttyUSB*)"
    if problem.errno in (errno.EACCES, errno.EPERM):
        remedy = "join its group (often: sudo usermod -aG dialout $USER) and log in again"
        return f"no permission for {spec.device}; {remedy}"
    if problem.errno in (errno.EBUSY, errno.EAGAIN, errno.EWOULDBLOCK):
        return f"{spec.device} is in use by another program (a ground station? ModemManager?)"
    if problem.errno in (errno.ENOTTY, errno.EISDIR):
        return f"{spec.device} is no serial port"
    return _text(problem)


def _text(problem: OSError) -> str:
    return problem.strerror or str(problem)
