"""Says which system packages lack before pip tries to build pyfuse3 without them.

pyfuse3 comes as source, and its own error names a file and not the package that holds it. This runs when pip
reads the metadata of a source tree or archive. MAVFTPFS_ANY_MACHINE=1 builds a wheel where it will not run.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sysconfig
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface


def lacking() -> list[str]:
    """Return the Debian packages whose files pyfuse3 is built with and that are not here."""
    header = os.path.join(sysconfig.get_path("include"), "Python.h")
    pkg_config = shutil.which("pkg-config") is not None
    wanted = {
        "gcc": any(map(shutil.which, ("gcc", "cc", "clang"))),
        "pkg-config": pkg_config,
        "libfuse3-dev": pkg_config and not subprocess.run(["pkg-config", "--exists", "fuse3"]).returncode,
        "python3-dev": os.path.exists(header),
    }
    return [package for package, there in wanted.items() if not there]


class CustomMetadataHook(MetadataHookInterface):
    """Changes nothing; refuses to go on where something lacks."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Check this machine."""
        if os.environ.get("MAVFTPFS_ANY_MACHINE") or importlib.util.find_spec("pyfuse3"):
            return
        packages = lacking()
        if packages:
            raise RuntimeError(f"mavftpfs needs these first: sudo apt install fuse3 {' '.join(packages)}")
