"""Fixtures of the core's tests: one small room, its map, and a localizer in it."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest
from hypothesis import settings

sys.path.insert(0, str(Path(__file__).parent))

# the machine's load is no property of the code; the same examples on every run
settings.register_profile("core", deadline=None, derandomize=True, database=None)
settings.load_profile("core")


@pytest.fixture
def no_ros_path() -> dict[str, str]:
    """Environment for subprocesses that import this checkout."""
    root = str(Path(__file__).resolve().parents[2])
    return {**os.environ, "PYTHONPATH": root}
