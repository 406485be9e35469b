"""Accuracy does not fall unseen: a fixed evaluation against stored figures (guard.py)."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import guard
import pytest

from igaussian_core.config import Config
from igaussian_core.features import make_matcher

DATA = Path(os.environ.get("IGAUSSIAN_DATA", guard.ROOT.parent / "shared" / "data"))
STORED: dict[str, Any] = json.loads(guard.STORED.read_text())
NAMES = list(guard.cases(DATA))


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> guard.Compile:
    if make_matcher(Config().features).name != "xfeat":
        pytest.skip("the stored figures are XFeat's, which is not installed")
    return guard.compiler(tmp_path_factory.mktemp("guard"), DATA)


@pytest.mark.parametrize("name", NAMES)
def test_accuracy_has_not_fallen(
    name: str, compiled: Callable[[str], Any], request: pytest.FixtureRequest
) -> None:
    if "photos" in name:
        request.getfixturevalue("data_dir")  # skips with a reason where there is none
    found = guard.cases(DATA)[name](compiled)
    assert guard.differences(name, found, STORED) == []


def test_a_loss_is_told_with_its_figures() -> None:
    for name, figures in STORED["figures"].items():
        assert guard.differences(name, figures, STORED) == []
        assert guard.differences(name, {**figures, "success": figures["success"] + 0.1,
                                        "median_deg": 0.0}, STORED) == []  # fmt: skip
        for key, factor in (("success", 0.8), ("median_distance", 2.0), ("median_deg", 1.6)):
            worse = {**figures, key: figures[key] * factor + (0.01 if factor > 1 else 0)}
            (line,) = guard.differences(name, worse, STORED)
            assert name in line and key in line
        (line,) = guard.differences(name, {**figures, "wrong_accepted": 1 + 1e-9}, STORED)
        assert "wrong_accepted" in line
        (line,) = guard.differences(name, {**figures, "median_deg": float("nan")}, STORED)
        assert "nan" in line


def test_every_case_has_stored_figures() -> None:
    assert set(STORED["figures"]) >= set(NAMES)
    assert {"demo, rendered", "demo, drive"} <= set(NAMES)
