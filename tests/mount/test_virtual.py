"""ArduPilot's and PX4's `@` trees: their sizes lie, what is read must not (servers.md 11)."""

from __future__ import annotations

from pathlib import Path

import pytest

from mavftpfs.sim.pseudo import VirtualTrees
from tests.mount.conftest import Field
from tests.support.mounts import Mount

TRUTH = VirtualTrees()
FILLED = {name.decode(): data for name, data in TRUTH.sys_files.items() if data}
"""What is in @SYS and can be opened; the vehicle lists more names than it can open."""


@pytest.fixture(scope="module")
def ardupilot(module_field: Field, small_tree: Path) -> Mount:
    """A mount of a vehicle with all virtual trees."""
    return module_field.mount(module_field.sim(small_tree, "ardupilot").source)


def test_parameters_are_one_consistent_file(ardupilot: Mount, tmp_path: Path) -> None:
    ardupilot.run("cp", ardupilot.path / "@PARAM/param.pck", tmp_path)
    packed = (tmp_path / "param.pck").read_bytes()
    blocks = [block for block in range(16, 240) if TRUTH.content(b"@PARAM/param.pck", block) == packed]
    assert blocks, "param.pck is none of the vehicle's files, whatever the block size"


def test_a_query_selects_parameters(ardupilot: Mount) -> None:
    name = "param.pck?start=2&count=3"
    assert ardupilot.read_bytes(ardupilot.path / "@PARAM" / name) == TRUTH.content(
        b"@PARAM/" + name.encode(), 239
    )


@pytest.mark.parametrize("tool", ["cp", "rsync"])
def test_copying_tools_get_the_true_bytes(ardupilot: Mount, tmp_path: Path, tool: str) -> None:
    sources = [f"./@SYS/{name}" for name in FILLED]
    if tool == "cp":
        (tmp_path / "@SYS").mkdir()
        ardupilot.run("cp", *sources, tmp_path / "@SYS", cwd=ardupilot.path)
    else:
        ardupilot.run("rsync", "-aR", *sources, f"{tmp_path}/", cwd=ardupilot.path)
        again = ardupilot.run("rsync", "-aRi", *sources, f"{tmp_path}/", cwd=ardupilot.path).stdout
        assert again == ""
    assert {path.name: path.read_bytes() for path in (tmp_path / "@SYS").iterdir()} == FILLED


def test_writing_below_at_is_refused(ardupilot: Mount) -> None:
    assert ardupilot.errno_of("open(sys.argv[1], 'w')", ardupilot.path / "@PARAM/param.pck") == "EROFS"
    assert ardupilot.errno_of("open(sys.argv[1], 'w')", ardupilot.path / "@SYS/new.txt") == "EROFS"
