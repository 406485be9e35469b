"""Where the bundled files lie: in a checkout, or under the prefix of an installation."""

from __future__ import annotations

import sys
from pathlib import Path

from igaussian_core.errors import IGaussianError

_SHARE = Path("share") / "igaussian_ros"


def resource(name: str) -> Path:
    """Path of a bundled file or folder, e.g. "bags/demo" or "msg_configs/localizer.yaml".

    Raises:
        IGaussianError: it is in none of the places where an installation puts it.
    """
    roots = resource_roots()
    for root in roots:
        if (root / name).exists():
            return root / name
    raise IGaussianError(
        f"{name}: not installed; looked in {', '.join(str(root) for root in roots)}"
    )


def resource_roots() -> list[Path]:
    """The checkout, if this is one, then `share/igaussian_ros` of every enclosing prefix."""
    here = Path(__file__).resolve()
    roots = [here.parents[1]] if (here.parents[1] / "package.xml").exists() else []
    # <prefix>/lib/python3.x/site-packages/igaussian_core/resources.py, for venv, --user, colcon
    prefixes = [*here.parents[2:6], Path(sys.prefix)]
    for prefix in prefixes:
        share = prefix / _SHARE
        if share.is_dir() and share not in roots:
            roots.append(share)
    return roots or [here.parents[1]]
