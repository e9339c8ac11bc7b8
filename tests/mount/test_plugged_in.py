"""The files of `mavftpfs install`, in use: the systemd unit's own commands, as systemd would run them, on a
simulated serial port; and install, remove, install, upgrade and uninstall, as root and in a namespace."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import stat
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

import mavftpfs
from mavftpfs.cli import install
from tests.mount.conftest import Field
from tests.support.mounts import abort_mount, install_programs, mounted_at, wait_until
from tests.support.vehicles import PROJECT


def commands(unit: str, key: str, home: Path, device: str, options: str) -> list[list[str]]:
    """Return the commands of one key, with what systemd puts in place of % and $."""
    places = {"%h": str(home), "%I": device, "%i": device.replace("/", "-"), "${MAVFTPFS_OPTIONS}": options}
    (source,) = re.findall(r"^Environment=MAVFTPFS_SOURCE=(\S+) MAVFTPFS_OPTIONS=$", unit, re.MULTILINE)
    places = {"${MAVFTPFS_SOURCE}": source, **places}
    found = []
    for line in re.findall(rf"^{key}=-?(.*)$", unit, re.MULTILINE):
        words = shlex.split(line)
        for mark, text in places.items():
            words = [word.replace(mark, text) for word in words]
        found.append(words)
    return found


def run(*words: str) -> None:
    """Run one command as systemd does: without a shell and with a bound."""
    subprocess.run(words, check=True, timeout=90, stdin=subprocess.DEVNULL)


def test_the_unit_mounts_and_unmounts(field: Field, tiny_tree: Path, tmp_path: Path) -> None:
    vehicle = field.sim(tiny_tree, link="pty")
    device = vehicle.source.partition(",")[0].removeprefix("/dev/")
    unit = install._unit(install_programs(tmp_path), "mavftpfs@.service")
    mountpoint = tmp_path / f"drone-{device.replace('/', '-')}"

    def take(key: str) -> None:
        for words in commands(unit, key, tmp_path, device, "ro"):
            run(*words)

    try:
        take("ExecStartPre")
        take("ExecStart")
        assert mounted_at(mountpoint)
        shown = subprocess.run(
            ["cat", mountpoint / "README.txt"], capture_output=True, timeout=60, check=True
        )
        assert shown.stdout == (tiny_tree / "README.txt").read_bytes()
        take("ExecStop")
        wait_until("it is unmounted", lambda: not mounted_at(mountpoint))
        take("ExecStopPost")
        assert not mountpoint.exists()
    finally:
        abort_mount(mountpoint)


# -- the life of an installation ------------------------------------------------------------------

IN_A_NAMESPACE = """
set -eu
mkdir "$1"
mount -t tmpfs none "$1"
for place in usr/local usr/sbin etc; do
    mkdir -p "$1/up/$place" "$1/scratch/$place"
    mount -t overlay none -o "lowerdir=/$place,upperdir=$1/up/$place,workdir=$1/scratch/$place" "/$place"
done
find /usr/local/bin /usr/local/share /usr/local/lib/systemd /usr/sbin /etc/udev -depth -name '*mavftpfs*' \\
    -exec rm -r {} + 2>/dev/null || true  # this computer may have one installed, or lack a directory
written() { (cd "$1/up" && find . -type f -o -type l | sort | sed "s,^,$2 ,"); }
"""


def closed_directories() -> list[Path]:
    """Return the directories above these tests' Python that are closed to other users, the topmost first."""
    python = Path(sys.executable)
    above = {*python.parents, *python.resolve().parents}
    return sorted(path for path in above if not path.stat().st_mode & stat.S_IXOTH)


def opened(place: Path) -> str:
    """Return the lines of a script that show a directory with another mode."""
    own = f"$1/open{str(place).replace('/', '-')}"
    where = shlex.quote(str(place))
    layers = f'"lowerdir={place},upperdir={own}/up,workdir={own}/work"'
    return f'mkdir -p "{own}/up" "{own}/work"\nmount -t overlay none -o {layers} {where}'


class Installation:
    """A program that root installed, run in a namespace whose /usr/local, /usr/sbin and /etc are copies."""

    def __init__(self, folder: Path) -> None:
        self.copy, self.packages, self.programs = folder / "copy", folder / "library", folder / "bin"
        shutil.copytree(PROJECT / "mavftpfs", self.packages / "mavftpfs")
        self.programs.mkdir()
        install_programs(self.programs, self.packages)

    def run(self, *steps: str, code: int = 0) -> dict[str, list[str]]:
        """Run the steps of a script; return what its lines say, by their first words. All users can run these
        tests' Python there, wherever it lies."""
        script = "\n".join([IN_A_NAMESPACE, *map(opened, closed_directories()), *steps])
        places = map(str, (self.copy, self.programs, self.packages))
        command = ["unshare", "--mount", "sh", "-c", script, "sh", *places]
        done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
        assert done.returncode == code, done.stdout + done.stderr
        said: dict[str, list[str]] = {"error": done.stderr.splitlines()}
        for line in done.stdout.splitlines():
            key, _, words = line.partition(" ")
            said.setdefault(key, []).append(words)
        return said


@pytest.fixture
def installation() -> Iterator[Installation]:
    """One that is not installed yet, where all users can run it: pytest's own directories are closed."""
    with TemporaryDirectory(prefix="mavftpfs-", dir="/tmp") as folder:
        os.chmod(folder, 0o755)
        yield Installation(Path(folder))


CHECK = 'mount.mavftpfs -f udpin:127.0.0.1:14550 /mnt && echo "version $(/usr/local/bin/mavftpfs --version)"'


@pytest.mark.needs("namespaces", "root's Python")
def test_install_remove_install_upgrade_and_uninstall(installation: Installation) -> None:
    said = installation.run(
        '"$2/mavftpfs" install >/dev/null',
        'written "$1" first',
        CHECK,
        "/usr/local/bin/mavftpfs install --remove >/dev/null",
        'written "$1" removed',
        '"$2/mavftpfs" install >/dev/null',
        'written "$1" second',
        CHECK,
        # the next version, at another place
        """sed -i 's/^__version__ = .*/__version__ = "9.8.7"/' "$3/mavftpfs/__init__.py" """,
        'mv "$2" "$2.new"',
        '"$2.new/mavftpfs" install >/dev/null',
        'written "$1" upgraded',
        CHECK,
        "grep -c 9.8.7 /usr/local/share/man/man1/mavftpfs.1",
        "mavftpfs install --remove >/dev/null",
        'rm -r "$2.new"',
        'written "$1" uninstalled',
    )
    assert len(said["first"]) >= 9
    assert {"./usr/local/bin/mavftpfs", "./usr/sbin/mount.mavftpfs"} < set(said["first"])
    assert said["first"] == said["second"] == said["upgraded"]
    assert [version.split()[1] for version in said["version"]] == [mavftpfs.__version__] * 2 + ["9.8.7"]
    assert "removed" not in said
    assert "uninstalled" not in said


@pytest.mark.needs("namespaces", "root's Python")
def test_what_others_put_there_stays(installation: Installation) -> None:
    said = installation.run(
        'ln -s "$2/mavftpfs" /usr/local/bin/mavftpfs',  # as pipx does
        "mavftpfs install >/dev/null",
        CHECK,
        "mavftpfs install --remove >/dev/null",
        'written "$1" left',
    )
    assert said["left"] == ["./usr/local/bin/mavftpfs"]


@pytest.mark.needs("namespaces")
@pytest.mark.parametrize("place", ["$2/mavftpfs", "$3"])
def test_root_does_not_run_what_another_user_owns(installation: Installation, place: str) -> None:
    said = installation.run(
        f'chown 1000 "{place}"', "trap 'written \"$1\" left' EXIT", '"$2/mavftpfs" install', code=1
    )
    assert "left" not in said
    (line,) = said["error"]
    assert "can be changed by others than root" in line
    assert "PIPX_HOME" in line


@pytest.mark.needs("namespaces", "root's Python")
def test_root_installs_nothing_that_others_could_not_run(installation: Installation) -> None:
    steps = ('chmod 700 "$2"', "trap 'written \"$1\" left' EXIT", '"$2/mavftpfs" install')
    said = installation.run(*steps, code=1)
    assert "left" not in said
    (line,) = said["error"]
    assert "/bin is closed to other users (mode 0700)" in line
    assert "install a copy for all users: sudo PIPX_HOME=/opt/pipx" in line
