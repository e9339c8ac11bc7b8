"""The end of a mount: its message and the files that it keeps, and the files of an earlier mount."""

from __future__ import annotations

import os
import stat
from collections.abc import Sequence
from pathlib import Path
from typing import cast

import pytest

from mavftpfs.cache.recovery import SpoolDirectory
from mavftpfs.cache.tree import Tree
from mavftpfs.client import undelivered
from mavftpfs.link.messages import Address
from mavftpfs.mount import drain
from tests.ops.faketree import FakeTree


@pytest.fixture(autouse=True)
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The user's state directory."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    return tmp_path


async def end_of(tree: FakeTree) -> list[str]:
    said: list[str] = []
    await drain.drain_or_keep(cast(Tree, tree), "udpin:0.0.0.0:14550", said.append)
    return said


async def test_what_cannot_be_delivered_is_kept_and_said(state: Path) -> None:
    class Keeping(FakeTree):
        def recover_to(self, directory: Path) -> Sequence[Path]:
            directory.mkdir(parents=True)
            for path in super().recover_to(directory):
                path.write_bytes(b"kept")
                Path(f"{path}.json").write_text('{"path": "/x", "whole": true}')
            return super().recover_to(directory)

    tree = Keeping(left=[b"/a", b"/b"])
    (line,) = await end_of(tree)
    name, directory = tree.calls[-1]
    assert name == "recover_to"
    place = os.fsdecode(directory)
    assert line == (
        f"2 files did not reach the vehicle; they are kept in {place}; "
        f"upload them with: mavftpfs recover udpin:0.0.0.0:14550 {place}"
    )
    assert Path(place).parent == state / "mavftpfs" / "recovered"
    assert place.endswith("-udpin_0.0.0.0_14550")


async def test_a_recovery_directory_that_cannot_be_made_is_said() -> None:
    class Full(FakeTree):
        def recover_to(self, directory: Path) -> Sequence[Path]:
            raise OSError(28, "No space left on device")

    (line,) = await end_of(Full(left=[b"/a"]))
    assert "put them back" not in line
    assert "1 file did not reach the vehicle" in line
    assert "No space left" in line


@pytest.mark.holds("promise 3")
def test_a_spool_is_private_and_by_vehicle(state: Path) -> None:
    with undelivered.spool_for(Address(1, 2)) as one, undelivered.spool_for(Address(1, 2)) as two:
        assert one is not None
        assert two is not None
        assert one.path != two.path
        assert one.path.parent == two.path.parent == state / "mavftpfs" / "spool" / "1-2"
        for path in (one.path, one.path.parent, one.path.parent.parent, state / "mavftpfs"):
            assert stat.S_IMODE(path.stat().st_mode) == 0o700
    with undelivered.spool_for(None) as unknown:
        assert unknown is not None
        assert unknown.path.parent.name == "unknown"


@pytest.mark.parametrize(
    ("facts", "told"),
    [
        ('{"path": "/f", "whole": true}', "upload it with: mavftpfs recover tcp:x:1 "),
        ('{"path": "/f", "whole": true, "broken": true}', "list it with: mavftpfs recover"),
    ],
)
def test_the_file_of_a_dead_mount_is_named_once(state: Path, facts: str, told: str) -> None:
    """A part is listed, because `recover` does not put it back."""
    dead = SpoolDirectory(state / "base")
    (dead.path / "000001.data").write_bytes(b"held")
    (dead.path / "000001.json").write_text(facts)
    dead.close()
    spool = SpoolDirectory(state / "base")
    line = undelivered.rescue(spool, "tcp:x:1")
    assert line.startswith("1 file of an earlier mount did not reach the vehicle; it is in ")
    assert f"; {told}" in line
    assert undelivered.rescue(spool, "tcp:x:1") == ""
    spool.close()


def test_what_cannot_be_moved_is_said(state: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(self: SpoolDirectory, recovery: Path) -> list[Path]:
        raise OSError("the disk is full")

    spool = SpoolDirectory(state / "base")
    monkeypatch.setattr(SpoolDirectory, "rescue", fail)
    assert "the disk is full" in undelivered.rescue(spool, "x")
    spool.close()
