"""Two rooms that look alike: an image of one fits both, and only a prior can tell."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import room

from igaussian_core.compile_map import CompileOptions, compile_map
from igaussian_core.config import Config
from igaussian_core.gaussian_map import GaussianMap, save_ply
from igaussian_core.geometry import compose, pose_error
from igaussian_core.localizer import Localizer
from igaussian_core.result import LocalizationResult, Status
from igaussian_core.training.map_network import add_untrained_network

SHIFT = compose(np.eye(3), [6.0, 0.0, 0.0])
QUERIES = room.query_poses(3, seed=8)
NETWORKS = pytest.mark.parametrize("twins", ["landmarks alone", "with a network"], indirect=True)


@pytest.fixture(scope="module")
def twin_rooms(room_map: GaussianMap, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The room twice, six metres apart, compiled."""
    folder = tmp_path_factory.mktemp("twins")
    moved = room_map.means + SHIFT[:3, 3].astype(np.float32)
    both = GaussianMap(
        np.concatenate([room_map.means, moved]),
        *(np.tile(part, (2,) + (1,) * (part.ndim - 1)) for part in (
            room_map.quats_wxyz, room_map.scales, room_map.opacities, room_map.sh
        )),
    )  # fmt: skip
    save_ply(both, folder / "rooms.ply")
    poses = room.source_poses()
    room.write_poses(folder / "poses.json", [*poses, *(SHIFT @ T for T in poses)])
    target = folder / "rooms.igmap"
    compile_map(
        folder / "rooms.ply", target, folder / "poses.json", CompileOptions(views=2 * len(poses))
    )
    return target


@pytest.fixture(scope="module")
def twins(
    request: pytest.FixtureRequest, twin_rooms: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """The two rooms, without a pose network or as `igaussian map compile` leaves them."""
    if request.param == "landmarks alone":
        return twin_rooms
    target = tmp_path_factory.mktemp("twins with a network") / "rooms.igmap"
    shutil.copytree(twin_rooms, target)
    add_untrained_network(target)
    return target


def localized(
    path: Path, room_map: GaussianMap, prior: np.ndarray | None = None, **config: float
) -> list[LocalizationResult]:
    flat = {"runtime.budget_ms": 60000.0, **{k.replace("__", "."): v for k, v in config.items()}}
    localizer = Localizer.open(path, Config.from_flat(flat))
    return [
        localizer.localize(
            room.photo(room_map, T), room.CAMERA, None if prior is None else prior @ T
        )
        for T in QUERIES
    ]


@NETWORKS
def test_neither_of_two_like_places_is_accepted(twins: Path, room_map: GaussianMap) -> None:
    for result in localized(twins, room_map):
        assert result.status is Status.INCONSISTENT
        assert "two places fit alike, 6 m and 0 degrees apart" in result.reason
        assert result.T_map_cam is None and result.covariance is None
        assert result.confidence < 0.25


@NETWORKS
def test_a_prior_tells_them_apart(twins: Path, room_map: GaussianMap) -> None:
    for place in (np.eye(4), SHIFT):
        for result, T in zip(localized(twins, room_map, place), QUERIES, strict=True):
            assert result.ok and result.T_map_cam is not None
            angle, distance = pose_error(result.T_map_cam, place @ T)
            assert angle < 0.15 and distance < 0.004


@NETWORKS
def test_without_rivals_either_is_accepted(twins: Path, room_map: GaussianMap) -> None:
    assert all(r.ok for r in localized(twins, room_map, coarse__rival_share=2.0))


def test_one_room_has_no_rivals(room_igmap: Path, room_map: GaussianMap) -> None:
    assert all(r.ok for r in localized(room_igmap, room_map))
