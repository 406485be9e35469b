"""The covariance's factor of a map: known answers, and what a calibrated map says afterwards."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import room
from PIL import Image
from typer.testing import CliRunner

from igaussian_core import calibrate as calibration
from igaussian_core.calibrate import calibrate_map, covariance_scale
from igaussian_core.camera import Camera
from igaussian_core.cli import app
from igaussian_core.errors import DatasetError, MapError
from igaussian_core.gaussian_map import GaussianMap
from igaussian_core.geometry import compose
from igaussian_core.localizer import Localizer
from igaussian_core.map_package import open_package, with_covariance_scale
from igaussian_core.pnp import pose_covariance


def chi_squared(count: int, seed: int = 0) -> np.ndarray:
    return np.square(np.random.default_rng(seed).normal(size=(count, 6))).sum(axis=1)


@pytest.mark.parametrize("factor", [0.2, 1.0, 7.0])
def test_a_known_factor_is_found(factor: float) -> None:
    assert covariance_scale(factor * chi_squared(4000)) == pytest.approx(factor, rel=0.05)


def test_calibrated_errors_lie_inside_as_often_as_they_should() -> None:
    scale = covariance_scale(0.3 * chi_squared(30))
    inside = (0.3 * chi_squared(4000, seed=1) / scale < calibration.NEES_95).mean()
    assert 0.88 < inside < 0.99


def test_a_long_tail_asks_for_more_than_the_mean() -> None:
    nees = np.concatenate([np.full(90, 0.5), np.full(10, 40.0)])
    assert covariance_scale(nees) == pytest.approx(40 / 12.592, rel=0.02)
    assert covariance_scale(np.zeros(9)) > 0.01 and covariance_scale(np.full(9, 1e9)) <= 1e4


def test_few_poses_stay_near_the_default() -> None:
    few, many = np.full(12, 0.6), np.full(1200, 0.6)
    assert 0.15 < covariance_scale(few) < 0.25 and covariance_scale(many) < 0.11


# --- of a map ---


@pytest.fixture
def copy(room_igmap: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(room_igmap, tmp_path / "room.igmap"))


def write_photos(folder: Path, gmap: GaussianMap, count: int, noise: float = 0.0) -> Path:
    """Photos whose written positions are off by a normal error of so many metres."""
    poses = room.query_poses(count, seed=21)
    rng = np.random.default_rng(0)
    for index, T in enumerate(poses):
        Image.fromarray(room.photo(gmap, T, seed=index)).save(folder / f"{index}.png")
    written = [T @ compose(np.eye(3), rng.normal(0, noise, 3)) for T in poses]
    return room.write_poses(folder / "poses.json", written)


def test_errors_of_known_size_are_measured(
    copy: Path, room_map: GaussianMap, tmp_path: Path
) -> None:
    """Where poses are said to be 20 mm off, the covariance becomes one of about 20 mm."""
    photos = write_photos(tmp_path, room_map, 12, noise=0.02)
    found = calibrate_map(copy, photos)
    assert not found.held_out and found.poses == found.photos == 12
    assert found.mean_nees > 20 and found.inside_95 < 0.5 and found.scale > 5
    manifest = open_package(copy).manifest
    assert (manifest.covariance_scale, manifest.covariance_poses) == (found.scale, 12)
    image = room.photo(room_map, room.query_poses(1)[0])
    covariance = Localizer.open(copy).localize(image, room.CAMERA).covariance
    assert covariance is not None and np.linalg.eigvalsh(covariance).min() > 0
    assert 0.005 < np.sqrt(np.diag(covariance)[:3].mean()) < 0.08
    again = calibrate_map(copy, photos)  # the factor in place does not count twice
    assert again.scale == pytest.approx(found.scale, rel=1e-6)


def test_photos_of_the_training_are_left_out(
    copy: Path, room_map: GaussianMap, tmp_path: Path
) -> None:
    photos = write_photos(tmp_path, room_map, 14)
    note = tmp_path / "map.json"
    note.write_text(json.dumps({"trained_on": ["0.png", "1.png"]}))
    found = calibrate_map(copy, photos)
    assert found.held_out and found.photos == 12
    assert found.mean_nees < 20
    note.write_text(json.dumps({"trained_on": [f"{i}.png" for i in range(14)]}))
    assert not calibrate_map(copy, photos).held_out


def test_the_command(copy: Path, room_map: GaussianMap, tmp_path: Path) -> None:
    photos = write_photos(tmp_path, room_map, 12)

    def run(*arguments: object) -> str:
        ran = CliRunner().invoke(app, [str(a) for a in arguments], env={"COLUMNS": "200"})
        assert ran.exit_code == 0, ran.output
        return ran.output

    assert "not calibrated" in run("map", "info", copy)
    said = run("map", "calibrate", copy, "--photos", photos)
    assert "measured on 12 of 12 photos" in said and "perhaps trained on" in said
    assert "measured on 12 photos" in run("map", "info", copy)


def test_too_few_photos_change_nothing(copy: Path, room_map: GaussianMap, tmp_path: Path) -> None:
    before = (copy / "manifest.json").read_text()
    with pytest.raises(DatasetError, match="12 at least"):
        calibrate_map(copy, write_photos(tmp_path, room_map, 4))
    assert (copy / "manifest.json").read_text() == before


def test_the_factor_in_the_manifest(copy: Path, room_map: GaussianMap) -> None:
    image = room.photo(room_map, room.query_poses(1)[0])
    plain = Localizer.open(copy).localize(image, room.CAMERA)
    with_covariance_scale(copy, 2.5, 12)
    scaled = Localizer.open(copy).localize(image, room.CAMERA)
    assert np.allclose(scaled.covariance, 2.5 * plain.covariance, rtol=1e-6)  # type: ignore[operator, arg-type]
    assert np.allclose(scaled.T_map_cam, plain.T_map_cam)  # type: ignore[arg-type]
    assert scaled.status is plain.status
    for wrong in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(MapError, match="covariance_scale"):
            with_covariance_scale(copy, wrong, 12)
    assert open_package(copy).manifest.covariance_scale == 2.5


def test_a_map_of_before_is_not_calibrated(copy: Path) -> None:
    file = copy / "manifest.json"
    data = json.loads(file.read_text())
    del data["covariance_scale"], data["covariance_poses"]
    file.write_text(json.dumps(data))
    manifest = open_package(copy).manifest
    assert (manifest.covariance_scale, manifest.covariance_poses) == (1.0, 0)
    file.write_text(json.dumps({**data, "covariance_scale": -2.0}))
    with pytest.raises(MapError, match="covariance_scale"):
        open_package(copy)


@pytest.mark.parametrize("noisy", [True, False])
@pytest.mark.parametrize("shape", ["many", "few", "line", "one place", "far"])
def test_a_covariance_is_positive_definite_always(shape: str, noisy: bool) -> None:
    """Also of points that do not determine a pose."""
    rng = np.random.default_rng(1)
    camera = Camera(640, 480, 500.0, 500.0, 319.5, 239.5)
    points = rng.uniform([-1, -1, 2], [1, 1, 4], (200, 3))
    if shape == "few":
        points = points[:4]
    elif shape == "line":
        points = np.linspace([-0.5, 0, 3], [0.5, 0, 3], 50)
    elif shape == "one place":
        points = np.tile([[0.0, 0.0, 3.0]], (20, 1))
    elif shape == "far":
        points *= 1e4
    uv = points[:, :2] / points[:, 2:] * 500 + (319.5, 239.5)
    uv += rng.normal(0, 0.3 if noisy else 0, uv.shape)
    covariance = pose_covariance(camera, np.eye(4), points, uv, 32.0)
    depth = float(np.median(points[:, 2]))
    units = np.diag([1 / depth] * 3 + [1.0] * 3)  # so that rounding is judged in one unit
    assert np.allclose(covariance, covariance.T)
    assert np.linalg.eigvalsh(units @ covariance @ units).min() > 0
