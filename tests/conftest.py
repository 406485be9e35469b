"""Fixtures that all tests share."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def repo_root() -> Path:
    """The checkout."""
    return ROOT


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Real photos, maps and bags that lie beside the project; skips where they are absent."""
    candidates = [Path(os.environ["IGAUSSIAN_DATA"])] if "IGAUSSIAN_DATA" in os.environ else []
    candidates.append(ROOT.parent / "shared" / "data")
    for path in candidates:
        if (path / "bags").is_dir() or (path / "sets").is_dir():
            return path
    pytest.skip(f"no real data: neither IGAUSSIAN_DATA nor {candidates[-1]}")
