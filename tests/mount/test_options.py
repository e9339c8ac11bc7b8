"""Options, and the other commands that talk to a mount: mount(8), status, umount."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from mavftpfs.protocol.payload import crc32
from tests.mount.conftest import Field
from tests.support.mounts import Mount, install_programs, processes_in, wait_until


def mount_line(path: Path) -> list[str]:
    """Return the words of the kernel's line about a mount."""
    lines = Path("/proc/self/mounts").read_text().splitlines()
    return next(line.split() for line in lines if line.split()[1] == str(path))


@pytest.fixture(scope="module")
def plain(module_field: Field) -> Mount:
    """A mount of a card with one file, with flags of the kernel's."""
    card = module_field.local("card")
    (card / "file").write_text("content\n")
    return module_field.mount(module_field.sim(card).source, "noatime", "nosuid", "nodev", "noexec")


def test_kernel_shows_source_and_type(plain: Mount) -> None:
    words = mount_line(plain.path)
    assert words[0] == plain.source
    assert words[2] == "fuse.mavftpfs"
    assert {"noexec", "nosuid", "nodev", "default_permissions"} <= set(words[3].split(","))


def test_extended_attributes(plain: Mount) -> None:
    file = plain.path / "file"
    code = (
        "import os, sys; file, root = sys.argv[1:]\n"
        "print(os.listxattr(file), os.listxattr(root), os.getxattr(file, 'user.mavftp.crc32').decode())\n"
        "print(os.getxattr(root, 'user.mavftpfs.status').decode())"
    )
    shown, status = plain.python(code, file, plain.path).splitlines()
    checksum = crc32(b"content\n")
    assert shown == f"[] ['user.mavftpfs.status'] {checksum:08x}"
    assert json.loads(status)["source"] == plain.source
    assert plain.errno_of("os.getxattr(sys.argv[1], 'user.nothing')", file) == "ENODATA"


REFUSED = {
    "os.symlink('a', sys.argv[1] + '/b')": "EPERM",
    "os.link(sys.argv[1] + '/file', sys.argv[1] + '/b')": "EPERM",
    "os.mkfifo(sys.argv[1] + '/b')": "EPERM",
    "os.setxattr(sys.argv[1] + '/file', 'user.x', b'y')": "ENOTSUP",
    "os.removexattr(sys.argv[1] + '/file', 'user.x')": "ENOTSUP",
    "os.readlink(sys.argv[1] + '/file')": "EINVAL",
    "os.fsync(os.open(sys.argv[1], os.O_RDONLY))": "",
    "assert os.access(sys.argv[1] + '/file', os.W_OK)": "",
}
"""Snippets, and the errno of each: "" for success."""


def test_what_no_card_has_is_refused(plain: Mount) -> None:
    assert {code: plain.errno_of(code, plain.path) for code in REFUSED} == REFUSED
    refused = plain.run("fallocate", "-l", "1M", plain.path / "file", code=None)
    assert "not supported" in refused.stderr
    assert plain.run("cat", plain.path / "file").stdout == "content\n"


def test_options_of_look_and_of_fstab(field: Field, small_tree: Path) -> None:
    words = ("_netdev", "nofail", "noauto", "user", "x-systemd.automount", "defaults")
    look = ("ro", "uid=1234", "gid=4321", "fmask=0137", "dmask=0026")
    old = ("auto_unmount", "verify=size")
    mount = field.mount(field.sim(small_tree).source, *look, *words, *old)
    line = mount_line(mount.path)
    assert "ro" in line[3].split(",")
    shown = mount.run("stat", "-c", "%u %g %a", mount.path / "README.txt", mount.path / "sizes").stdout
    assert shown.split() == ["1234", "4321", "440", "1234", "4321", "551"]
    said = mount.alive().text()
    assert "option auto_unmount is gone, and is ignored: " in said
    assert "option verify is gone, and is still understood: write verify_max=0" in said


def test_every_payload_is_printed_decoded(field: Field, small_tree: Path) -> None:
    mount = field.mount(field.sim(small_tree).source, argv=("-d",))
    mount.run("cat", mount.path / "sizes/478.bin")
    assert mount.unmount() == 0
    text = mount.alive_or_ended().text()
    lines = [line for line in text.splitlines() if "/sizes/478.bin" in line or "mounted" in line]
    assert len(lines) > 1
    assert [line for line in lines if not re.match(r"\d\d:\d\d:\d\d\.\d+ ", line)] == []
    opened = set(re.findall(r" -> OPEN_FILE_RO .* b'(.*)'", text))
    assert opened == {"/sizes/478.bin", "@PARAM/param.pck"}, "the mount looks for the second one, once"


# mount(8) runs the program named by the type from a fixed PATH, and the helper of a type from /sbin, so both
# are made to hold ours, in a mount namespace of its own; Python may lie there, too. The script prints what
# the test looks at, and how other tools see the mount; it is not seen outside.
MOUNT_8 = """
for place in /usr/local/bin /usr/sbin; do
    mount -t overlay none -o "lowerdir=$1:$place" "$place" || exit 90
done
mount -t fuse.mavftpfs "$2" "$3" -o "ro,noatime,noexec,allow_other,uid=1000,nofail,_netdev" || exit
grep " $3 " /proc/self/mounts
stat -c "uid %u" "$3/README.txt" &&
diff -r "$4/sizes" "$3/sizes" &&
umount "$3"
mount -t mavftpfs "$2" "$3" -o nofail,_netdev || exit
df -t fuse.mavftpfs --output=target | grep -x "$3"
findmnt -n -t fuse.mavftpfs -o TARGET | grep -x "$3"
mount -t fuse.mavftpfs | grep -c " on $3 type "
umount "$3"
"""


@pytest.mark.needs("namespaces")
def test_mount_8_by_both_types_and_umount_8(field: Field, small_tree: Path, tmp_path: Path) -> None:
    install_programs(tmp_path)
    mount = field.prepare(field.sim(small_tree).source)
    places = (tmp_path, mount.source, mount.path, small_tree)
    done = mount.run("unshare", "--mount", "sh", "-c", MOUNT_8, "sh", *places, code=None)
    assert done.returncode == 0, done.stderr
    line, *others = done.stdout.splitlines()
    assert line.split()[:3] == [mount.source, str(mount.path), "fuse.mavftpfs"]
    assert {"ro", "noexec"} <= set(line.split()[3].split(","))
    assert others == ["uid 1000", str(mount.path), str(mount.path), "1"]
    wait_until("the daemons ended", lambda: not processes_in(mount.path))
