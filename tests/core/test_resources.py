"""Bundled files of a checkout, and of an installation's prefix."""

from __future__ import annotations

from pathlib import Path

import pytest

from igaussian_core import resources
from igaussian_core.errors import IGaussianError
from igaussian_core.resources import resource


def test_in_the_checkout(repo_root: Path) -> None:
    assert resource("package.xml") == repo_root / "package.xml"


@pytest.mark.parametrize("folder", ["lib/python3.11/site-packages", "local/lib/python3/dist"])
def test_under_a_prefix(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, folder: str) -> None:
    package = tmp_path / folder / "igaussian_core"
    share = tmp_path / "share" / "igaussian_ros" / "msg_configs"
    package.mkdir(parents=True)
    share.mkdir(parents=True)
    monkeypatch.setattr(resources, "__file__", str(package / "resources.py"))
    assert resource("msg_configs") == share


def test_missing_says_where_it_looked(repo_root: Path) -> None:
    with pytest.raises(IGaussianError, match="no/such.*looked in .*" + str(repo_root)):
        resource("no/such")
