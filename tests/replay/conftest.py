"""Runs that replays are made of: missions of one scene, a fleet."""

from __future__ import annotations

from pathlib import Path

import pytest
from fleet_runs import write_run
from replay_runs import write_mission

from mjcollect.scene.moving import MovingBox


@pytest.fixture(scope="session")
def mission(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_mission(tmp_path_factory.mktemp("one") / "first")


@pytest.fixture(scope="session")
def other(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Flown in another order, with a fault."""
    fault = {"success": False, "violations": [{"kind": "contact", "t": 2.5}]}
    return write_mission(tmp_path_factory.mktemp("two") / "second", (1, 0), **fault)


@pytest.fixture(scope="session")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("fleet"))


@pytest.fixture
def moving() -> MovingBox:
    return MovingBox((4.0, 6.0, 8.0), ((20, 20, 20), (60, 20, 20), (60, 80, 20)), 7.0, 0.3)
