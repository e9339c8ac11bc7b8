"""Fixtures of the mount tier: kernel mounts of vehicles that are processes of their own.

Nothing here skips: a machine that cannot mount fails these tests (scripts/setup installs what is needed).
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TypeVar

import pytest

from mavftpfs.sim.tree import MemoryTree
from tests.support.lying import LyingVehicle
from tests.support.mounts import Mount
from tests.support.requests import CountedVehicle
from tests.support.trees import SMALL_SIZES, build_tree
from tests.support.vehicles import HOST, MavsdkVehicle, Process, SimVehicle, UdpVehicle, free_udp_port

V = TypeVar("V", bound=UdpVehicle)


class Field:
    """Starts vehicles and mounts in one folder, and ends and judges all of them: mounts first."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._stack = ExitStack()

    def sim(
        self, root: Path, profile: str = "px4", options: Sequence[str] = (), *, link: str | None = None
    ) -> SimVehicle:
        """Start a simulated vehicle."""
        return self._started(SimVehicle(root, self._subfolder(), profile, options, link=link))

    def counted_sim(self, root: Path, profile: str) -> CountedVehicle:
        """Start a simulated vehicle that counts what it is asked."""
        return self._stack.enter_context(CountedVehicle(root, profile))

    def mavsdk(self, root: Path, bad_link: Sequence[str] = ()) -> MavsdkVehicle:
        """Start the MAVSDK library's server."""
        return self._started(MavsdkVehicle(root, self._subfolder(), bad_link=bad_link))

    def lying(self, tree: MemoryTree) -> LyingVehicle:
        """Start a vehicle whose answers can be changed."""
        return self._stack.enter_context(LyingVehicle(tree, f"udpout:{HOST}:{free_udp_port()}"))

    def mount(self, source: str, *options: str, argv: Sequence[str] = ()) -> Mount:
        """Mount SOURCE and wait for it."""
        mount = self.prepare(source, *options, argv=argv)
        mount.start()
        return mount

    def prepare(self, source: str, *options: str, argv: Sequence[str] = ()) -> Mount:
        """Return a mount that was not started yet; `finish` is taken care of."""
        folder = self._subfolder()
        path = folder / "mnt"
        path.mkdir()
        mount = Mount(source, path, folder, options, argv)
        self._stack.callback(mount.finish)
        return mount

    def own(self, process: Process) -> None:
        """End a process after the mounts that are made from now on: without their vehicle these wait."""
        self._stack.callback(process.kill)

    def local(self, name: str) -> Path:
        """Return a new directory on the local disk."""
        path = self._subfolder() / name
        path.mkdir()
        return path

    def close(self) -> None:
        """End everything; the first complaint is raised, after all have ended."""
        self._stack.close()

    def _started(self, vehicle: V) -> V:
        self._stack.callback(vehicle.finish)
        vehicle.start()
        return vehicle

    def _subfolder(self) -> Path:
        number = len(os.listdir(self.folder))
        path = self.folder / str(number)
        path.mkdir()
        return path


@pytest.fixture
def field(tmp_path: Path) -> Iterator[Field]:
    """A field for one test."""
    field = Field(tmp_path)
    yield field
    field.close()


@pytest.fixture
def open_field() -> Iterator[Field]:
    """A field in a directory that other users may enter; they may not enter those of pytest."""
    with tempfile.TemporaryDirectory(dir="/tmp") as name, ExitStack() as stack:
        Path(name).chmod(0o755)
        field = Field(Path(name))
        stack.callback(field.close)
        yield field


@pytest.fixture(scope="module")
def module_field(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Field]:
    """A field for all tests of a module."""
    field = Field(tmp_path_factory.mktemp("field"))
    yield field
    field.close()


@pytest.fixture(scope="session")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The whole reference tree; nobody may change it."""
    return build_tree(tmp_path_factory.mktemp("tree"))


@pytest.fixture(scope="session")
def tiny_tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Something of everything, for slow and bad links; nobody may change it."""
    return build_tree(tmp_path_factory.mktemp("tiny_tree"), sizes=(0, 1, 239, 478, 35850), many=5)


@pytest.fixture(scope="session")
def small_tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The reference tree without large files; nobody may change it."""
    return build_tree(tmp_path_factory.mktemp("small_tree"), sizes=SMALL_SIZES, many=30)
