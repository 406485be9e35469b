"""ROS 2 around igaussian_core: the node `localizer` and a bag replayer.

ROS only converts, calls the core from a worker thread, and publishes.
"""

from __future__ import annotations

import os
import sys


def _warn_of_foreign_rmw() -> None:
    """The wheels bring Fast DDS only; with another one asked for, rcl ends the process at once."""
    wanted = os.environ.get("RMW_IMPLEMENTATION", "")
    if "_ROS_WHEELS_BOOTSTRAP_COMPLETE" in os.environ and wanted not in ("", "rmw_fastrtps_cpp"):
        print(
            f"igaussian_ros: RMW_IMPLEMENTATION={wanted}, but ROS 2 from PyPI has only "
            "rmw_fastrtps_cpp: unset the variable (rcl ends with status 102 otherwise)",
            file=sys.stderr,
        )


_warn_of_foreign_rmw()
# torch's threads else spin while they wait for one another: on a robot whose cores are busy with
# other processes that makes a frame several times slower. Read when torch is loaded.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
