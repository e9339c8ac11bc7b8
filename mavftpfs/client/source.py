"""What SOURCE and the options stand for: a link, or a mount. Layer: client."""

from __future__ import annotations

import os
from dataclasses import replace

from mavftpfs.client.files import Target, mountpoint_of
from mavftpfs.client.options import Options, with_root
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
            raise UsageError(f"{source} is a mount: name the directory below it, not by root=")
        return Target(None, options, mount=mount)
    place = source.partition("#")[0]
    no_device = place.startswith("/") and not place.startswith("/dev/") and not os.path.lexists(place)
    if no_device or os.path.isdir(place):
        raise UsageError(f"no vehicle is mounted on {place}")
    spec = parse_source(source)
    options = with_root(options, spec.subtree)
    return Target(spec if options.baud is None else replace(spec, baud=options.baud), options)
