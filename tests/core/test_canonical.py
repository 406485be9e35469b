"""The pose network's own camera, and its units."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from igaussian_core.camera import Camera
from igaussian_core.coarse.backbone import STRIDE
from igaussian_core.coarse.canonical import (
    canonical_camera,
    cell_centres,
    cell_rays,
    resampled,
    turned,
)
from igaussian_core.coarse.pose_scale import PoseScale, contracted, expanded
from igaussian_core.geometry import rotation_from_vector

CAMERAS = [
    Camera(640, 480, 525.0, 525.0, 319.5, 239.5),
    Camera(1080, 1920, 1400.0, 1410.0, 530.0, 955.0),
    Camera(400, 400, 555.0, 555.0, 199.5, 199.5),
    Camera(128, 96, 100.0, 100.0, 63.5, 47.5),
]


@pytest.mark.parametrize("camera", CAMERAS, ids=str)
def test_whole_cells_and_the_same_field_of_view(camera: Camera) -> None:
    small = canonical_camera(camera)
    assert small.width % STRIDE == small.height % STRIDE == 0
    assert 0.6 < small.width * small.height / 128**2 < 1.5
    corners = [
        np.array([[-0.5, -0.5], [c.width - 0.5, c.height - 0.5]]) for c in (camera, small)
    ]
    for a, b in zip(camera.normalized(corners[0]), small.normalized(corners[1]), strict=True):
        assert np.allclose(a, b, atol=1e-6)


@pytest.mark.parametrize("camera", CAMERAS, ids=str)
@pytest.mark.parametrize("zoom", [1.0, 0.7, 1.3])
def test_resampling_keeps_directions(camera: Camera, zoom: float) -> None:
    """A spot drawn along a ray is found along that ray in the canonical image."""
    small = canonical_camera(CAMERAS[0])
    camera = Camera(
        camera.width, camera.height, zoom * camera.fx, zoom * camera.fy, camera.cx, camera.cy
    )
    ray = np.array([[0.11, -0.07]])
    u, v = ray[0] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    y, x = np.mgrid[: camera.height, : camera.width]
    radius = 2.5 * camera.fx / small.fx
    spot = 255 * np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * radius**2))
    image = np.repeat(spot[..., None], 3, -1).astype(np.uint8)
    seen = resampled(image, camera, small)[..., 0].astype(float)
    seen -= np.median(seen)
    seen[seen < 40] = 0
    y, x = np.mgrid[: small.height, : small.width]
    centre = np.array([(x * seen).sum(), (y * seen).sum()]) / seen.sum()
    wanted = ray[0] * (small.fx, small.fy) + (small.cx, small.cy)
    assert seen.shape == (small.height, small.width)
    assert np.abs(centre - wanted).max() < 0.3


def test_cells_and_their_rays() -> None:
    camera = CAMERAS[3]
    centres = cell_centres(camera)
    assert centres.shape == (6, 8, 2)
    assert centres[0, 0].tolist() == [7.5, 7.5] and centres[5, 7].tolist() == [119.5, 87.5]
    assert np.allclose(cell_rays(camera)[0, 0], camera.normalized(np.array([[7.5, 7.5]]))[0][:2])


coordinates = st.floats(-50, 50)


@given(st.tuples(coordinates, coordinates, coordinates))
def test_contraction_is_bounded_and_can_be_undone(point: tuple[float, float, float]) -> None:
    small = contracted(np.array([point]))
    assert np.linalg.norm(small) < 4.0
    assert np.allclose(expanded(small)[0], point, rtol=1e-6, atol=1e-9)


def test_near_points_are_not_contracted() -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    assert np.allclose(contracted(points), points)


def test_units_of_a_map() -> None:
    scale = PoseScale((1.0, 2.0, 3.0), 4.0)
    assert np.allclose(scale.normalized([5.0, 2.0, 3.0]), [1, 0, 0])
    assert np.allclose(scale.scene(scale.normalized([[7.0, -2.0, 9.0]])), [[7, -2, 9]])


def test_a_turned_image_is_what_the_turned_camera_sees() -> None:
    camera = Camera(160, 128, 150.0, 150.0, 79.5, 63.5)
    point = np.array([0.1, -0.05, 1.0])
    rotation = rotation_from_vector(np.radians([4.0, -3.0, 8.0]))
    image = np.zeros((128, 160, 3), np.uint8)
    u, v = np.rint(camera.project(point[None])[0]).astype(int)
    cv2.circle(image, (int(u), int(v)), 4, (255, 255, 255), -1)
    seen = turned(image, camera, rotation)
    row, column = np.array(np.nonzero(seen[..., 0] > 127)).mean(1)
    # a point of the scene in the turned camera: T_scene_cam @ rotation
    wanted = camera.project((rotation.T @ point)[None])[0]
    assert np.abs(wanted - (column, row)).max() < 0.7
    assert np.array_equal(turned(image, camera, np.eye(3)), image)
