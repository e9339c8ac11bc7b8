"""Programs that write, on a real mount of every kind of server, compared with a local directory.

Each vehicle is mounted once. After each step the card must be what the local directory is: what a program
was told is done lies on the card, no temporary name of ours with it.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.mount.conftest import Field
from tests.support.mounts import command, wait_until
from tests.support.places import FOLDERS, NO_RENAME, start_place
from tests.support.takingturns import taking_turns
from tests.support.terminal import NANO
from tests.support.trees import differing
from tests.support.twins import Twins
from tests.support.vehicles import PROJECT

FAT = ("px4-nuttx", "ardupilot5")
NOT_ON_FAT = re.compile(rb'[?"*:<>|\\]')


@pytest.fixture(scope="module", params=taking_turns(FOLDERS, soak=("px4", "ardupilot", "mavsdk")))
def kind(request: pytest.FixtureRequest) -> str:
    """The server's name; the library's own is here in place of the simulated MAVSDK."""
    name: str = request.param
    return name


@pytest.fixture(scope="module")
def twins(kind: str, module_field: Field) -> Twins:
    """The server with an empty card, mounted."""
    place = start_place(module_field, kind)
    mount = module_field.mount(place.vehicle.source, *place.options)
    return Twins(mount, mount.path / place.folder, place.card, module_field.local("twin"))


@pytest.fixture(scope="module")
def brought(kind: str, tiny_tree: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tree that is copied to the vehicle, without names that its card cannot hold."""
    if kind not in FAT:
        return tiny_tree
    copy = tmp_path_factory.mktemp("brought")
    shutil.copytree(tiny_tree, copy, dirs_exist_ok=True)
    for name in os.listdir(os.fsencode(copy / "names")):
        if NOT_ON_FAT.search(name):
            os.unlink(os.path.join(os.fsencode(copy / "names"), name))
    return copy


@pytest.mark.holds("promise 2")
def test_cp_and_tar_bring_a_tree(twins: Twins, brought: Path, tmp_path: Path) -> None:
    archive = tmp_path / "tree.tar"
    subprocess.run(["tar", "-cf", archive, "-C", brought, "sizes", "names", "deep"], check=True, timeout=60)
    twins.both('cp -r "$1" copied; mkdir out; tar -xf "$2" -C out', brought, archive)
    twins.both('cp -r "$1"/sizes/. copied/sizes; rm -r out', brought)  # over what is there


def test_rsync_twice_transfers_once(twins: Twins, brought: Path, kind: str) -> None:
    """Where nothing can be renamed rsync copies its temporary file, unless it writes in place at once."""
    for way in ("--no-inplace", "--inplace")[: 2 if kind in NO_RENAME else 1]:
        script = f'rsync -a {way} --itemize-changes "$1"/ synced{way}/'
        assert "35850.bin" in twins.both(script, brought)
        assert twins.both(script, brought) == ""


EDITS = {
    "make": "seq 1 3000 > lines; mkdir -p d/e; echo x > d/x; echo y > d/e/y; cp lines big; cp d/x Upper",
    "append": "echo more >> lines; printf '' >> lines; echo again >> lines; tail -c 20 lines",
    "replace": "seq 5 50 > lines; cat lines",
    "empty": "touch new; : > d/x; cp /dev/null none; sync new d/x none; stat -c '%n %s' new d/x none",
    "touch": "touch -d '2020-02-02 02:02:02.5' big d; stat -c '%n %y' big d; touch big",
    "dd": "dd if=big of=odd bs=241 count=37 skip=3 status=none;"
    "dd if=big of=odd bs=239 seek=5 count=2 conv=notrunc status=none;"
    "dd if=big of=odd bs=1000 seek=40 count=1 conv=notrunc,fsync status=none;"
    "cmp <(tail -c 1000 odd) <(head -c 1000 big)",
    "truncate": "truncate -s 1000 big; truncate -s +5000 big; truncate -s 0 Upper; truncate -s 77 Upper;"
    "cksum big Upper",
    "sparse": "truncate -s 40000 hole; printf end >> hole; cp --sparse=always hole sparse; cmp hole sparse",
    "chmod": "chmod 600 big; stat -c %a big; chmod 755 d; stat -c %a d; chown $(id -u):$(id -g) big",
    "swap files": "echo s > .big.swp; cat .big.swp; mv .big.swp .big.swo; rm .big.swo",
    "delete": "touch d/a.tmp d/e/b.tmp; find . -name '*.tmp' -delete; rm -r odd copied synced*; ls -A d",
}
MOVES = {
    "rename": "mv d/e/y d/y2; mv d f; mv big f/; mv lines f/e/; ls f f/e",
    "rename over": "seq 1 9 > one; seq 1 7 > two; mv two one; cat one; mv f/e g; mkdir h; mv -T h f/h; ls f",
    "sed -i": "seq 1 2000 > s; sed -i 's/7/seven/' s; head -8 s; cksum s",
}


@pytest.mark.holds("promise 2")
@pytest.mark.parametrize("step", EDITS)
def test_small_edits(twins: Twins, step: str) -> None:
    twins.both(EDITS[step])


@pytest.mark.parametrize("step", MOVES)
def test_names(twins: Twins, step: str, kind: str) -> None:
    if kind in NO_RENAME and step == "sed -i":
        code = "import os, sys; os.rename(sys.argv[1] + '/Upper', sys.argv[1] + '/other')"
        assert twins.mount.errno_of(code, twins.shown) == "EXDEV"
        return
    twins.both(MOVES[step])


def test_vim_and_nano_save(twins: Twins) -> None:
    twins.both("seq 1 300 > vim.txt; vim -es -u NONE -i NONE -c '%s/5/five/' -c 'wq' vim.txt; cat vim.txt")
    twins.both(f"{NANO} nano.txt; cat nano.txt")


GIT = """
git init -q --template= -b main repo; cd repo; seq 1 500 > file; git add file
git -c gc.auto=0 commit -q -m first; echo more >> file; git -c gc.auto=0 commit -q -a -m second
git fsck --no-progress; git status --short; git log --format='%H %s'
rm -r .git/index .git/config .git/logs
"""
"""At the end without what holds inode numbers, times, and what git finds out about the disk."""


def test_git(twins: Twins, kind: str) -> None:
    if kind in NO_RENAME:
        return  # every lock file of git is renamed
    assert "second" in twins.both(GIT)


@pytest.mark.holds("promise 2")
def test_many_writers_at_once(twins: Twins, brought: Path) -> None:
    twins.both("mkdir crowd; for n in $(seq 50); do seq $n $((n * 20)) > crowd/$n & done; wait")
    script = 'cp -r "$1"/sizes a & first=$!; cp -r "$1"/names b; wait $first; cp -r b c & cksum a/*.bin; wait'
    twins.both(script, brought)


def test_put_mv_and_rm_without_a_mount(field: Field, tiny_tree: Path) -> None:
    card, readme = field.local("card"), tiny_tree / "README.txt"
    source = field.mavsdk(card).source
    said, _ = command("put", "-r", source, tiny_tree / "sizes", readme, "/")
    count = len(list((tiny_tree / "sizes").iterdir())) + 1
    assert said.count(", verified by size") == count
    assert said.count(", verified by size and CRC32\n") == count - 1, "one is empty"
    assert differing(tiny_tree / "sizes", card / "sizes") == []
    argv = [sys.executable, "-m", "mavftpfs", "put", source, "-", "/from_stdin"]
    subprocess.run(argv, input=b"piped", check=True, capture_output=True, cwd=PROJECT, timeout=60)
    assert (card / "from_stdin").read_bytes() == b"piped"
    command("mkdir", "-p", source, "/new/deep")
    command("mv", source, "/README.txt", "mftp:///new/deep")
    assert (card / "new/deep/README.txt").read_bytes() == readme.read_bytes()
    command("rm", "-r", source, "/new", "/sizes", "/from_stdin")
    assert list(card.iterdir()) == []


def test_a_put_that_is_interrupted_says_that_the_old_file_is_there(field: Field, tmp_path: Path) -> None:
    card = field.local("card")
    (card / "f").write_bytes(b"old")
    (tmp_path / "f").write_bytes(os.urandom(500_000))
    vehicle = field.sim(card)
    words = ("put", vehicle.source, tmp_path / "f", "/f", "-o", "bwlimit=50000")
    argv = (sys.executable, "-m", "mavftpfs", *words)
    with subprocess.Popen(argv, stderr=subprocess.PIPE, text=True, cwd=PROJECT) as put:
        wait_until("it is being sent", lambda: any(path.stat().st_size > 10_000 for path in card.iterdir()))
        put.send_signal(signal.SIGINT)
        said = put.communicate(timeout=60)[1]
    assert said.endswith(
        "0 of 1 files are on the vehicle; /f was being uploaded: the vehicle keeps what it had\n"
    )
    assert put.returncode == 130
    assert [path.read_bytes() for path in card.iterdir()] == [b"old"]
