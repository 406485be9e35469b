"""Text files of trajectories and poses that other tools read and write.

TUM: one line a pose, `stamp tx ty tz qx qy qz qw`, stamp in seconds. Results of the public
visual localization benchmark: `name qw qx qy qz tx ty tz` of the world-to-camera transform.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from igaussian_core.errors import DatasetError
from igaussian_core.geometry import (
    compose,
    inverse,
    quaternion_from_rotation,
    rotation_from_quaternion,
)

Array = NDArray[np.float64]


def write_tum(path: str | Path, poses: Iterable[tuple[float, Array]]) -> None:
    """Write (stamp in seconds, T_world_cam) lines."""
    lines = ["# stamp tx ty tz qx qy qz qw"]
    for stamp, T in poses:
        w, x, y, z = quaternion_from_rotation(T[:3, :3])
        numbers = " ".join(f"{value:.9f}" for value in (*T[:3, 3], x, y, z, w))
        lines.append(f"{stamp:.9f} {numbers}")
    _write(Path(path), lines)


def read_tum(path: str | Path) -> list[tuple[float, Array]]:
    """(stamp in seconds, T_world_cam) of a trajectory, in the file's order.

    Raises:
        DatasetError: unreadable, or a line that holds no pose.
    """
    result = []
    for number, words in _rows(Path(path)):
        try:
            stamp, tx, ty, tz, qx, qy, qz, qw = map(float, words)
        except ValueError as error:
            raise DatasetError(f"{path}: line {number}: expected 8 numbers") from error
        if not (qx or qy or qz or qw):
            raise DatasetError(f"{path}: line {number}: the quaternion is all zero")
        rotation = rotation_from_quaternion([qw, qx, qy, qz])
        result.append((stamp, compose(rotation, [tx, ty, tz])))
    return result


def read_tum_list(path: str | Path) -> list[tuple[float, str]]:
    """(stamp in seconds, file name) of an image list such as rgb.txt.

    Raises:
        DatasetError: unreadable, or a line that is no stamp and name.
    """
    result = []
    for number, words in _rows(Path(path)):
        try:
            stamp, name = words
            result.append((float(stamp), name))
        except ValueError as error:
            raise DatasetError(f"{path}: line {number}: expected a stamp and a name") from error
    return result


def write_visual_localization(path: str | Path, poses: Iterable[tuple[str, Array]]) -> None:
    """Write (image name, T_world_cam) as `name qw qx qy qz tx ty tz` of T_cam_world.

    The form of visuallocalization.net; it wants names without folders, which is left to the
    names given here.
    """
    lines = []
    for name, T in poses:
        T_cam_world = inverse(T)
        values = (*quaternion_from_rotation(T_cam_world[:3, :3]), *T_cam_world[:3, 3])
        lines.append(f"{name} " + " ".join(f"{value:.9f}" for value in values))
    _write(Path(path), lines)


def _rows(path: Path) -> Iterable[tuple[int, list[str]]]:
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError) as error:
        raise DatasetError(f"{path}: unreadable: {error}") from error
    for number, line in enumerate(lines, 1):
        if line.strip() and not line.startswith("#"):
            yield number, line.split()


def _write(path: Path, lines: list[str]) -> None:
    try:
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    except OSError as error:
        raise DatasetError(f"{path}: cannot be written: {error}") from error
