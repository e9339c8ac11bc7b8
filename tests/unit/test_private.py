"""Files of a mount on the local disk: no other user may read them, and no symbolic link leads elsewhere."""

from __future__ import annotations

import logging
import stat
from collections.abc import Callable
from pathlib import Path

import pytest

from mavftpfs.cache.recovery import SpoolDirectory
from mavftpfs.cache.spool import Spool, SpoolContent
from mavftpfs.client.trace import TlogWriter
from mavftpfs.mount.daemon import log_in_background
from mavftpfs.mount.drain import keep_the_rest
from tests.support.rigs import Rig
from tests.unit.test_daemon import restored_logging

pytestmark = pytest.mark.holds("promise 10")

__all__ = ["restored_logging"]


def tlog(path: Path) -> None:
    TlogWriter(path).__exit__()


def log(path: Path) -> None:
    log_in_background(path, logging.INFO, socket="/nowhere")


def exposed(directory: Path) -> list[Path]:
    """Return what others may read, or even see, below a directory and of itself."""
    return [
        path
        for path in (directory, *directory.rglob("*"))
        if stat.S_IMODE(path.lstat().st_mode) != (0o700 if path.is_dir() else 0o600)
    ]


@pytest.mark.usefixtures("restored_logging")
@pytest.mark.parametrize("write", [tlog, log])
def test_records_and_logs_are_private_and_follow_no_link(
    write: Callable[[Path], None], tmp_path: Path
) -> None:
    write(tmp_path / "file")
    assert stat.S_IMODE((tmp_path / "file").stat().st_mode) == 0o600
    (tmp_path / "link").symlink_to(tmp_path / "precious")
    with pytest.raises(Exception, match="symbolic link"):
        write(tmp_path / "link")
    assert not (tmp_path / "precious").exists()


def test_what_a_killed_mount_left_is_private(tmp_path: Path) -> None:
    state = tmp_path / "state"
    killed = SpoolDirectory(state / "spool" / "1-1")
    content = SpoolContent(Spool(killed.path))
    content.put(0, b"precious")
    content.persist({"path": "/card/a", "size": 8})
    assert exposed(state) == []
    killed.close()
    again = SpoolDirectory(state / "spool" / "1-1")
    assert again.rescue(state / "recovered" / "now")
    assert exposed(state) == []
    again.close()


async def test_what_could_not_be_delivered_is_private(tmp_path: Path) -> None:
    state, made = tmp_path / "state", Rig("px4", {b"/d": None})
    async with made.mounted() as tree:
        file = await tree.create(b"/d/f", exclusive=True)
        await file.write(0, b"precious")
        made.link.cut()
        assert "kept in" in keep_the_rest(tree, state / "recovered" / "now")
        assert len(list(state.rglob("*"))) == 4
        assert exposed(state) == []
