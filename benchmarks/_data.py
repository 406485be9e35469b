"""Where the data for benchmarks lies."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import igaussian_core  # noqa: F401  before torch: says how idle threads wait


def data_folder() -> Path:
    """The folder in IGAUSSIAN_DATA, else ../shared/data beside the checkout; exits without."""
    folder = Path(
        os.environ.get("IGAUSSIAN_DATA", Path(__file__).parents[2] / "shared" / "data")
    )
    if not (folder / "sets").is_dir():
        sys.exit(f"{folder}: no data for benchmarks there; set IGAUSSIAN_DATA")
    return folder
