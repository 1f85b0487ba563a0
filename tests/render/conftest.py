"""Two fleets that tests draw: one that comes home, and one of which a UAV does not."""

from __future__ import annotations

from pathlib import Path

import pytest
from fleet_runs import write_run

from mjcollect.render.fleet import FleetProgress, load_fleet


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("fleet"))


@pytest.fixture(scope="session")
def fleet(folder: Path) -> FleetProgress:
    return load_fleet(folder)


@pytest.fixture(scope="session")
def failed(tmp_path_factory: pytest.TempPathFactory) -> FleetProgress:
    """UAV 1 does not come home from its second item."""
    return load_fleet(write_run(tmp_path_factory.mktemp("failed"), ended={1: 420}))
