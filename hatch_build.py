"""What the build does beyond packing: looks for what pyfuse3 needs, and fits README to a package index.

pyfuse3 comes as source, and its own error names a file and not the package that holds it. So this says first
which Debian packages lack, when pip reads the metadata of a source tree or archive. MAVFTPFS_ANY_MACHINE=1
builds a wheel where it will not run.

An index shows README alone. Its links and pictures get the address of Source in [project.urls]. Without one,
pictures are left out and links are plain words.
"""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import subprocess
import sysconfig
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

LINK = re.compile(r"(!?)\[([^\]]*)\]\((?!https?:|#)([^)\s]+)\)")


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


def for_an_index(text: str, source: str | None) -> str:
    """Return README with links that lead somewhere from anywhere."""

    def replaced(match: re.Match[str]) -> str:
        mark, words, target = match.groups()
        if source is None:
            return "" if mark else words
        return f"{mark}[{words}]({source}/{'raw' if mark else 'blob'}/HEAD/{target})"

    return re.sub(r"\n{3,}", "\n\n", LINK.sub(replaced, text))


class CustomMetadataHook(MetadataHookInterface):
    """Refuses to go on where something lacks; sets the readme."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Check this machine, and read README."""
        if not os.environ.get("MAVFTPFS_ANY_MACHINE") and importlib.util.find_spec("pyfuse3") is None:
            packages = lacking()
            if packages:
                words = " ".join(packages)
                raise RuntimeError(f"mavftpfs needs these first: sudo apt install fuse3 {words}")
        text = (Path(self.root) / "README.md").read_text()
        source = metadata.get("urls", {}).get("Source")
        metadata["readme"] = {"content-type": "text/markdown", "text": for_an_index(text, source)}
