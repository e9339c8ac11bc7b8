"""A whole tree through a real mount, from every simulated profile and from the MAVSDK library's own server.

Each vehicle is mounted once for all tests of this module. Every tool runs as its own process.
"""

from __future__ import annotations

import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest

from mavftpfs.sim.profiles import PROFILES
from tests.mount.conftest import Field
from tests.support.mounts import Mount
from tests.support.takingturns import taking_turns
from tests.support.trees import COMPARE, differing
from tests.support.vehicles import UdpVehicle

BAD_LINK = ("--seed", "7", "--loss", "0.05", "--dup", "0.02", "--reorder", "0.02", "--corrupt", "0.01")
VEHICLES = taking_turns(
    (*PROFILES, "mavsdk-server", "mavsdk-server-bad-link"), soak=("px4-nuttx", "mavsdk", "mavsdk-server")
)
"""The library's own server says more about MAVSDK than a simulated one."""


@dataclass
class Scene:
    """A vehicle's directory, and the mount that shows it."""

    expected: Path
    mount: Mount

    @property
    def path(self) -> Path:
        """The mountpoint."""
        return self.mount.path


@pytest.fixture(scope="module", params=VEHICLES)
def scene(request: pytest.FixtureRequest, module_field: Field, tree: Path) -> Scene:
    """The reference tree, mounted from the vehicle that the parameter names."""
    kind: str = request.param
    vehicle: UdpVehicle
    if kind.startswith("mavsdk-server"):
        vehicle = module_field.mavsdk(tree, BAD_LINK if kind.endswith("bad-link") else ())
    else:
        vehicle = module_field.sim(tree, kind)
    return Scene(tree, module_field.mount(vehicle.source, "ro"))


def bytes_of(*argv: str | Path) -> bytes:
    """Return what a command prints of a local file."""
    return subprocess.run([str(a) for a in argv], check=True, capture_output=True, timeout=30).stdout


@pytest.mark.holds("promise 1", "rule 14.36")
def test_walk_finds_the_same_names_sizes_and_bytes(scene: Scene) -> None:
    scene.mount.run(*COMPARE, scene.expected, scene.path, timeout=240)


def test_find_and_ls_and_du_agree_with_the_disk(scene: Scene) -> None:
    argv = ("-not", "-path", "*/@*", "-printf", "%P %y %s\\n")
    sizes_only = ("-type", "f")  # a directory's size is the file system's own affair
    shown = scene.mount.run("find", ".", *sizes_only, *argv, cwd=scene.path).stdout
    there = bytes_of("find", scene.expected, *sizes_only, *argv).decode(errors="surrogateescape")
    assert sorted(shown.splitlines()) == sorted(there.splitlines())
    names = scene.mount.run("ls", "-l", scene.path / "many").stdout.splitlines()
    assert len(names) == len(list((scene.expected / "many").iterdir())) + 1
    used = int(scene.mount.run("du", "-sb", "--apparent-size", scene.path / "sizes").stdout.split()[0])
    expected = sum(path.stat().st_size for path in (scene.expected / "sizes").iterdir())
    assert used >= expected
    kilobytes = int(scene.mount.run("du", "-sk", scene.path / "sizes").stdout.split()[0])
    assert kilobytes >= expected // 1024


def test_rsync_twice_transfers_once(scene: Scene, tmp_path: Path) -> None:
    argv = ("rsync", "-a", "--exclude", "@*", "--itemize-changes", f"{scene.path}/", f"{tmp_path}/copy/")
    first = scene.mount.run(*argv, timeout=240).stdout
    assert "131073.bin" in first
    assert differing(scene.expected, tmp_path / "copy") == []
    second = scene.mount.run(*argv, timeout=120).stdout
    assert second == ""


WRITES = (
    "open(sys.argv[1] + '/new.txt', 'w')",
    "os.truncate(sys.argv[1] + '/README.txt', 0)",
    "os.mkdir(sys.argv[1] + '/new')",
    "os.unlink(sys.argv[1] + '/README.txt')",
    "os.chmod(sys.argv[1] + '/README.txt', 0o600)",
)


@pytest.mark.holds("promise 3")
@pytest.mark.parametrize("scene", ["px4"], indirect=True)
def test_a_read_only_mount_refuses_every_change(scene: Scene) -> None:
    assert {scene.mount.errno_of(code, scene.path) for code in WRITES} == {"EROFS"}


@pytest.mark.holds("rule 14.30")
def test_what_is_not_there_is_enoent(scene: Scene) -> None:
    for name in ("nothing", "sizes/nothing", "nothing/below", "README.txtx"):
        assert scene.mount.errno_of("os.stat(sys.argv[1])", scene.path / name) == "ENOENT"
    assert scene.mount.errno_of("os.listdir(sys.argv[1])", scene.path / "README.txt") == "ENOTDIR"
    assert scene.mount.errno_of("open(sys.argv[1])", scene.path / "sizes") == "EISDIR"
