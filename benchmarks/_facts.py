"""What a benchmark says of its run besides its figures."""

from __future__ import annotations

import subprocess
from pathlib import Path

from igaussian_core.evaluate.report import machine_facts


def facts() -> dict[str, str]:
    """Machine, versions, date, and the commit that was run."""
    return {**machine_facts(), "commit": _commit()}


def _commit() -> str:
    folder = str(Path(__file__).parent)
    run = subprocess.run(
        ["git", "-C", folder, "describe", "--always", "--dirty"], capture_output=True, text=True
    )
    return run.stdout.strip() or "unknown"
