"""A ROS domain of its own for each run, and a small scene with map and recording."""

from __future__ import annotations

import os
import random
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")

ROOT = Path(__file__).resolve().parents[2]
# parallel runs must not hear one another; read when a ROS context begins
os.environ["ROS_DOMAIN_ID"] = str(random.SystemRandom().randint(1, 100))
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(
    ROOT / "msg_configs" / "fastdds_large_images.xml"
)
sys.path.insert(0, str(Path(__file__).parent))

import harness  # noqa: E402
import rclpy  # noqa: E402
import scene as scenes  # noqa: E402


@dataclass(frozen=True)
class Corner:
    """The scene, its compiled map, a recording of it and the recording's poses T_map_cam."""

    scene: scenes.Scene
    map_path: Path
    bag: Path
    poses: list[np.ndarray]


@pytest.fixture(scope="session")
def corner(tmp_path_factory: pytest.TempPathFactory) -> Corner:
    folder = tmp_path_factory.mktemp("corner")
    scene = scenes.Scene(1)
    map_path = scenes.compiled(scene, folder)
    return Corner(scene, map_path, folder / "drive", scenes.write_bag(scene, folder / "drive"))


@pytest.fixture(scope="session")
def ros() -> Iterator[None]:
    harness.init_ros()
    yield
    rclpy.try_shutdown()
