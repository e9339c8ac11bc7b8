"""The commands that need no mount, each as a user runs it: a process of its own, over a real link."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.mount.conftest import Field
from tests.support.mounts import mavftpfs
from tests.support.trees import differing
from tests.support.vehicles import SimVehicle


@pytest.fixture(scope="module")
def vehicle(module_field: Field, small_tree: Path) -> SimVehicle:
    """A vehicle that nobody mounts; one command after the other speaks with it."""
    return module_field.sim(small_tree)


def test_ls(vehicle: SimVehicle, small_tree: Path) -> None:
    out, _ = mavftpfs("ls", vehicle.source, "/")
    assert sorted(out.splitlines()) == sorted(
        path.name + "/" * path.is_dir() for path in small_tree.iterdir()
    )
    out, _ = mavftpfs("ls", vehicle.source, "/sizes", "/sizes/478.bin", "/deep")
    sizes = sorted(path.name for path in (small_tree / "sizes").iterdir())
    deep = sorted(path.name + "/" * path.is_dir() for path in (small_tree / "deep").iterdir())
    assert out.splitlines() == ["478.bin", "", "/sizes:", *sizes, "", "/deep:", *deep]
    out, _ = mavftpfs("ls", "-l", vehicle.source, "mftp://comp=1:/sizes")
    detailed = {line.split()[-1]: int(line.split()[0]) for line in out.splitlines()}
    assert detailed == {path.name: path.stat().st_size for path in (small_tree / "sizes").iterdir()}
    out, _ = mavftpfs("ls", "--json", f"{vehicle.source}#/deep", "/")
    kinds = {entry["name"]: entry["kind"] for entry in json.loads(out)}
    assert kinds == {
        path.name: "directory" if path.is_dir() else "file" for path in (small_tree / "deep").iterdir()
    }


@pytest.mark.holds("promise 1")
def test_get_is_verified(vehicle: SimVehicle, small_tree: Path, tmp_path: Path) -> None:
    out, _ = mavftpfs("get", vehicle.source, "/sizes/35850.bin", "/README.txt", "--to", tmp_path)
    assert [line.partition(": ")[2] for line in out.splitlines()] == [
        "35.9 kB, verified by size and CRC32",
        f"{(small_tree / 'README.txt').stat().st_size} B, verified by size and CRC32",
    ]
    assert (tmp_path / "35850.bin").read_bytes() == (small_tree / "sizes/35850.bin").read_bytes()
    for folder in ("deep", "names"):
        mavftpfs("get", "-r", vehicle.source, f"/{folder}", "--to", tmp_path)
        assert differing(small_tree / folder, tmp_path / folder) == []
