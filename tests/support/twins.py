"""The same commands on a mount and on a local directory, and what came of them compared.

What a program was told is done must be on the vehicle's card at that moment, so the card itself is compared,
beside what the mount shows.
"""

from __future__ import annotations

import os
import subprocess
from dataclasses import dataclass
from difflib import unified_diff
from pathlib import Path

from mavftpfs.cache.temporary import parse
from tests.support.mounts import Mount, wait_until
from tests.support.trees import COMPARE, differing, walk

PRELUDE = """
set -e
export LC_ALL=C.UTF-8 TZ=UTC GIT_CONFIG_GLOBAL=/dev/null GIT_CONFIG_NOSYSTEM=1 HOME=/proc/none
export GIT_AUTHOR_NAME=a GIT_AUTHOR_EMAIL=a@b GIT_COMMITTER_NAME=a GIT_COMMITTER_EMAIL=a@b
export GIT_AUTHOR_DATE=2026-01-01T00:00:00Z GIT_COMMITTER_DATE=2026-01-01T00:00:00Z
cd "$1"
shift
"""

LOCAL_TIMEOUT = 60.0


@dataclass
class Twins:
    """A vehicle's directory as the mount shows it (`shown`) and as it lies on the card, and a local twin."""

    mount: Mount
    shown: Path
    card: Path
    twin: Path

    def both(self, script: str, *args: str | Path) -> str:
        """Run a shell script here and there; both must succeed, print the same, and leave the same."""
        argv = ["bash", "-c", PRELUDE + script, "bash"]
        there = [str(arg) for arg in args]
        local = subprocess.run(
            [*argv, str(self.twin), *there],
            capture_output=True,
            text=True,
            errors="surrogateescape",
            timeout=LOCAL_TIMEOUT,
            check=False,
        )
        assert local.returncode == 0, local.stderr
        result = self.mount.run(*argv, self.shown, *there, timeout=240)
        differences = unified_diff(local.stdout.splitlines(), result.stdout.splitlines(), lineterm="", n=0)
        assert result.stdout == local.stdout, "\n".join(differences)
        self.compare()
        return result.stdout

    def compare(self) -> None:
        """The card must hold what the twin holds, and nothing else; so must the mount show it.

        Only an empty file may take its time: it is brought when it is released, which close() does not await.
        """
        if self._only_empty_files_differ():
            wait_until("empty files are brought", lambda: not self._differences())
        differences = self._differences()
        assert differences == [], "\n".join(differences[:20])
        self.mount.run(*COMPARE, self.twin, self.shown)

    def _differences(self) -> list[str]:
        return differing(self.twin, self.card)

    def _only_empty_files_differ(self) -> bool:
        there = {path for path, _ in walk(os.fsencode(self.card))}
        here = {path for path, _ in walk(os.fsencode(self.twin))}
        changed = {path for path in here if self._differs(path, there)}
        changed |= {path for path in map(meant, there - here) if path is not None}
        return bool(changed) and changed <= here and all(map(self._is_empty_here, changed))

    def _is_empty_here(self, path: bytes) -> bool:
        return (self.twin / os.fsdecode(path)).stat().st_size == 0

    def _differs(self, path: bytes, there: set[bytes]) -> bool:
        ours, theirs = self.twin / os.fsdecode(path), self.card / os.fsdecode(path)
        try:
            return path not in there or (ours.is_file() and ours.read_bytes() != theirs.read_bytes())
        except FileNotFoundError:  # it is being replaced at this moment
            return True


def meant(path: bytes) -> bytes | None:
    """Return the path that a name of ours stands for while it is being replaced, None for one under which a
    new file is sent; any other path as it is."""
    folder, name = os.path.split(path)
    ours = parse(name)
    if ours is None:
        return path
    return None if ours.target is None else os.path.join(folder, ours.target)
