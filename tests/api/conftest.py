"""Fixtures of the library's tests: simulated vehicles as processes, and connections to them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

import mavftpfs
from tests.mount.conftest import Field, field, module_field
from tests.support.vehicles import SimVehicle

__all__ = ["field", "module_field"]


@pytest.fixture(scope="module")
def vehicle(module_field: Field) -> SimVehicle:
    """A PX4 for all tests of a module."""
    return module_field.sim(module_field.local("card"), "px4")


@pytest.fixture(scope="module")
def shared(vehicle: SimVehicle) -> Iterator[mavftpfs.Drone]:
    """The connection to it, which believes no listing twice: the tests put files there themselves."""
    with mavftpfs.connect(vehicle.source, op_deadline=5, dir_timeout=0) as drone:
        yield drone


@pytest.fixture
def card(vehicle: SimVehicle, request: pytest.FixtureRequest) -> Path:
    """A directory of the card for this test alone; the vehicle knows it as `/NAME`."""
    path = vehicle.root / str(abs(hash(request.node.nodeid)))
    path.mkdir()
    return path


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave what tests fsspec's patterns and not us to the soak, on one vehicle: that takes a minute."""
    for item in [item for item in items if "_glob_edge_cases[" in item.name]:
        if "[px4-" in item.name:
            item.add_marker(pytest.mark.soak)
        else:
            items.remove(item)
