"""ArduPilot's and PX4's `@` trees: their sizes lie, what is read must not (servers.md 11)."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest
from pymavlink import mavwp

from mavftpfs.sim.pseudo import VirtualTrees
from tests.mount.conftest import Field
from tests.support.mounts import Mount

TRUTH = VirtualTrees()
FILLED = {name.decode(): data for name, data in TRUTH.sys_files.items() if data}
"""Files in @SYS that can be opened; the vehicle lists more names than it can open."""


@pytest.fixture(scope="module")
def ardupilot(module_field: Field, small_tree: Path) -> Mount:
    """A mount of a vehicle with all virtual trees."""
    return module_field.mount(module_field.sim(small_tree, "ardupilot").source)


def test_parameters_are_one_consistent_file(ardupilot: Mount, tmp_path: Path) -> None:
    ardupilot.run("cp", ardupilot.path / "@PARAM/param.pck", tmp_path)
    packed = (tmp_path / "param.pck").read_bytes()
    blocks = [block for block in range(16, 240) if TRUTH.content(b"@PARAM/param.pck", block) == packed]
    assert blocks, "param.pck is none of the vehicle's files, whatever the block size"


def test_rsync_gets_the_true_bytes(ardupilot: Mount, tmp_path: Path) -> None:
    sources = [f"./@SYS/{name}" for name in FILLED]
    ardupilot.run("rsync", "-aR", *sources, f"{tmp_path}/", cwd=ardupilot.path)
    again = ardupilot.run("rsync", "-aRi", *sources, f"{tmp_path}/", cwd=ardupilot.path).stdout
    assert again == ""
    assert {path.name: path.read_bytes() for path in (tmp_path / "@SYS").iterdir()} == FILLED


def test_modes_show_what_can_be_written(ardupilot: Mount) -> None:
    shown = {
        "README.txt": "-rw-r--r--",
        "@SYS": "dr-xr-xr-x",
        "@SYS/uarts.txt": "-r--r--r--",
        "@ROMFS": "dr-xr-xr-x",
        "@PARAM": "drwxr-xr-x",  # editors try to make files in it before they save
        "@PARAM/param.pck": "-r--r--r--",
        "@PARAM/params.parm": "-rw-r--r--",
        "@PARAM/last_error.txt": "-r--r--r--",
        "@MISSION/mission.waypoints": "-rw-r--r--",
    }
    stat = ("stat", "-c", "%n %A", *shown)
    told = dict(line.rsplit(" ", 1) for line in ardupilot.run(*stat, cwd=ardupilot.path).stdout.splitlines())
    assert told == shown
    ardupilot.run("chmod", "u+w", "@SYS/uarts.txt", cwd=ardupilot.path)
    assert not (ardupilot.path / "@SYS/uarts.txt").stat().st_mode & 0o222


@pytest.mark.needs("root")
def test_an_ordinary_user_edits_parameters_and_is_told_what_is_only_read(
    open_field: Field, small_tree: Path
) -> None:
    """An editor tries to make a file beside the text first, which the modes must not forbid."""
    options = ("allow_other", "uid=65534", "gid=65534")
    mount = open_field.mount(open_field.sim(small_tree, "ardupilot").source, *options)
    vim = "HOME=/tmp vim -es -u NONE -i NONE -n -c '%s/^RTL_ALT,.*/RTL_ALT,3100/' -c wq @PARAM/params.parm"
    user = ("setpriv", "--reuid=65534", "--regid=65534", "--clear-groups", "sh", "-c")
    where = f"cd {shlex.quote(str(mount.path))}"
    mount.run(*user, f"{where} && {vim} && grep -x RTL_ALT,3100 @PARAM/params.parm", cwd=Path("/"))
    for change in ("echo x > @SYS/uarts.txt", "echo x > @SYS/new", "mkdir @SYS/new", "rm @PARAM/param.pck"):
        done = mount.run(*user, f"{where} && {change}", cwd=Path("/"), code=None)
        assert ("Read-only" if "@PARAM" in change else "Permission denied") in done.stderr


PLAN = """QGC WPL 110
0 0 0 16 0 0 0 0 0 0 0 1
1 0 3 22 0 0 0 0 0 0 20 1
2 0 3 16 3 0 0 0 -35.361 149.161 30 1
"""


def test_a_mission_is_copied_there_and_back_and_an_editor_hears_of_a_bad_line(
    ardupilot: Mount, tmp_path: Path
) -> None:
    plan, missions = tmp_path / "plan.waypoints", ardupilot.path / "@MISSION"
    plan.write_text(PLAN)
    ardupilot.run("cp", plan, missions / "mission.waypoints")
    ardupilot.run("cp", missions / "mission.waypoints", plan)
    assert mavwp.MAVWPLoader().load(str(plan)) == 3
    vim = "vim -es -N -u NONE -i NONE -n -c '%s/\\t30\\t/\\tx\\t/' -c wq mission.waypoints"
    ardupilot.run("sh", "-c", vim, cwd=missions, code=1)
    assert b"mission.waypoints:4: 'x' is not a number" in ardupilot.read_bytes(missions / "last_error.txt")
