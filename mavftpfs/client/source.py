"""What SOURCE and the options stand for: a link, or a mount. Layer: client."""

from __future__ import annotations

import os

from mavftpfs.client.files import Target, mountpoint_of
from mavftpfs.client.options import Options, at_source
from mavftpfs.link.uri import parse_source
from mavftpfs.shared.errors import UsageError
from mavftpfs.shared.model import ROOT


def target_of(source: str, options: Options) -> Target:
    """Return what SOURCE names.

    Raises:
        UsageError: it is no SOURCE, or contradicts the options.
    """
    mount = mountpoint_of(source)
    if mount is not None:
        if options.root != ROOT:
            raise UsageError(f"{source} is a mount: name the directory in it, as {source}/dir")
        return Target(None, options, mount=mount)
    place = source.partition("#")[0]
    no_device = place.startswith("/") and not place.startswith("/dev/") and not os.path.lexists(place)
    if no_device or os.path.isdir(place):
        raise UsageError(f"no vehicle is mounted on {place}")
    return Target(*at_source(parse_source(source), options))
