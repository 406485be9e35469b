"""Fixtures of the core's tests: one small room, its map, and a localizer in it."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest
from hypothesis import settings

sys.path.insert(0, str(Path(__file__).parent))

import room as rooms  # noqa: E402

from igaussian_core.compile_map import CompileOptions, compile_map  # noqa: E402
from igaussian_core.config import Config  # noqa: E402
from igaussian_core.gaussian_map import GaussianMap, save_ply  # noqa: E402
from igaussian_core.localizer import Localizer  # noqa: E402

# the machine's load is no property of the code; the same examples on every run
settings.register_profile("core", deadline=None, derandomize=True, database=None)
settings.load_profile("core")


@pytest.fixture
def no_ros_path() -> dict[str, str]:
    """Environment for subprocesses that import this checkout."""
    root = str(Path(__file__).resolve().parents[2])
    return {**os.environ, "PYTHONPATH": root}


@pytest.fixture(scope="session")
def room_map() -> GaussianMap:
    """The Gaussians of a textured room."""
    return rooms.room(seed=1)


@pytest.fixture(scope="session")
def room_ply(room_map: GaussianMap, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The room as a file, its training cameras in poses.json beside it."""
    folder = tmp_path_factory.mktemp("room")
    save_ply(room_map, folder / "room.ply")
    rooms.write_poses(folder / "poses.json", rooms.source_poses())
    return folder / "room.ply"


@pytest.fixture(scope="session")
def room_igmap(room_ply: Path) -> Path:
    """The compiled room; not to be changed: copy it first."""
    target = room_ply.with_suffix(".igmap")
    compile_map(room_ply, target, room_ply.with_name("poses.json"), CompileOptions(views=24))
    return target


@pytest.fixture(scope="session")
def localizer(room_igmap: Path) -> Localizer:
    """A localizer in the room, whatever else the machine does meanwhile."""
    return Localizer.open(room_igmap, Config.from_flat({"runtime.budget_ms": 60000.0}))
