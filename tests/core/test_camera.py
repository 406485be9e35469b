"""The pixel rule, every model against OpenCV, resizing and undistortion."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from igaussian_core.camera import MODELS, Camera
from igaussian_core.errors import CameraError

PINHOLE = Camera(640, 480, 500.0, 505.0, 321.0, 238.0)
BARREL = Camera(640, 480, 420.0, 425.0, 325.0, 236.0, "plumb_bob", (-0.28, 0.08, 1e-3, -5e-4, 0.01))
PINCUSHION = Camera(640, 480, 500.0, 500.0, 310.0, 245.0, "plumb_bob", (0.12, 0.02, 0.0, 0.0))
RATIONAL = Camera(
    640, 480, 430.0, 430.0, 320.0, 240.0, "rational_polynomial",
    (0.3, 0.02, 1e-4, -1e-4, 0.001, 0.6, 0.08, 0.004),
)  # fmt: skip
FISHEYE = Camera(640, 480, 290.0, 292.0, 322.0, 239.0, "equidistant", (-0.02, 0.01, -0.004, 5e-4))
FISHEYE_ZERO = Camera(640, 480, 290.0, 292.0, 322.0, 239.0, "equidistant", (0.0,) * 4)
CAMERAS = {
    "pinhole": PINHOLE, "barrel": BARREL, "pincushion": PINCUSHION, "rational": RATIONAL,
    "fisheye": FISHEYE, "fisheye zero": FISHEYE_ZERO,
}  # fmt: skip
EVERY_CAMERA = pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())
DISTORTED = pytest.mark.parametrize(
    "camera", list(CAMERAS.values())[1:], ids=list(CAMERAS.keys())[1:]
)


def some_points(count: int = 200) -> np.ndarray:
    rng = np.random.default_rng(0)
    z = rng.uniform(0.5, 8, count)
    return np.stack([rng.uniform(-0.5, 0.5, count) * z, rng.uniform(-0.4, 0.4, count) * z, z], 1)


def test_first_pixels_centre_is_at_zero() -> None:
    camera = Camera(3, 3, 2.0, 2.0, 1.0, 1.0)  # looks through the middle of the middle pixel
    assert np.allclose(camera.project(np.array([[0, 0, 5.0]])), [[1, 1]])
    assert np.allclose(camera.project(np.array([[-0.5, -0.5, 1.0]])), [[0, 0]])


def test_axes_are_optical() -> None:
    (u, v), (u_right, _), (_, v_down) = PINHOLE.project(
        np.array([[0, 0, 1.0], [0.1, 0, 1.0], [0, 0.1, 1.0]])
    )
    assert (u, v) == (321.0, 238.0)
    assert u_right == pytest.approx(371.0)
    assert v_down == pytest.approx(288.5)


def hand_projection(camera: Camera, points: np.ndarray) -> np.ndarray:
    """OpenCV's documented formulas, written out."""
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    r2 = x * x + y * y
    if camera.model == "equidistant":
        r = np.sqrt(r2)
        theta = np.arctan(r)
        k = camera.dist
        bent = theta * (1 + sum(k[i] * theta ** (2 * i + 2) for i in range(4)))
        return np.stack(
            [camera.fx * bent / r * x + camera.cx, camera.fy * bent / r * y + camera.cy], 1
        )
    k1, k2, p1, p2, k3, k4, k5, k6 = (*camera.dist, *[0.0] * 8)[:8]
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.stack([camera.fx * xd + camera.cx, camera.fy * yd + camera.cy], 1)


@EVERY_CAMERA
def test_project_follows_the_formulas(camera: Camera) -> None:
    points = some_points()
    assert np.allclose(camera.project(points), hand_projection(camera, points), atol=1e-6)


@EVERY_CAMERA
def test_project_agrees_with_opencv(camera: Camera) -> None:
    points, zero = some_points()[:, None], np.zeros(3)
    project = cv2.fisheye.projectPoints if camera.model == "equidistant" else cv2.projectPoints
    theirs, _ = project(points, zero, zero, camera.K, np.array(camera.dist))
    assert np.allclose(camera.project(points[:, 0]), theirs[:, 0], atol=1e-9)


@EVERY_CAMERA
def test_normalized_undoes_project(camera: Camera) -> None:
    points = some_points()
    flat = camera.normalized(camera.project(points))
    assert np.allclose(flat, points[:, :2] / points[:, 2:], atol=1e-5)


@EVERY_CAMERA
def test_nothing_in_nothing_out(camera: Camera) -> None:
    assert camera.project(np.zeros((0, 3))).shape == (0, 2)
    assert camera.normalized(np.zeros((0, 2))).shape == (0, 2)


@given(st.integers(1, 900), st.integers(1, 900))
def test_resized_keeps_pixel_corners(width: int, height: int) -> None:
    small = BARREL.resized(width, height)
    points = some_points(20)
    u, v = BARREL.project(points).T
    us, vs = small.project(points).T
    assert np.allclose((us + 0.5) / width, (u + 0.5) / BARREL.width)
    assert np.allclose((vs + 0.5) / height, (v + 0.5) / BARREL.height)
    assert (small.width, small.height, small.dist) == (width, height, BARREL.dist)


def test_resized_agrees_with_an_image_resized_by_opencv() -> None:
    """A blob's centre moves in the picture as the camera says: no shift of half a pixel."""
    point = np.array([[0.137, -0.081, 1.0]])
    u, v = PINHOLE.project(point)[0]
    y, x = np.mgrid[0:480, 0:640]
    image = np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * 12.0**2)).astype(np.float32)
    small = cv2.resize(image, (160, 120), interpolation=cv2.INTER_AREA)
    y, x = np.mgrid[0:120, 0:160]
    centroid = [(small * x).sum() / small.sum(), (small * y).sum() / small.sum()]
    assert np.allclose(centroid, PINHOLE.resized(160, 120).project(point)[0], atol=0.01)


def test_scaled_to_fit_never_enlarges() -> None:
    assert PINHOLE.scaled_to_fit(640) is PINHOLE
    assert PINHOLE.scaled_to_fit(5000) is PINHOLE
    small = PINHOLE.scaled_to_fit(320)
    assert (small.width, small.height) == (320, 240)
    thin = Camera(10000, 3, 500.0, 500.0, 5000.0, 1.0).scaled_to_fit(100)
    assert (thin.width, thin.height) == (100, 1)


@DISTORTED
def test_undistorted_image_has_no_black_border(camera: Camera) -> None:
    white = np.full((camera.height, camera.width, 3), 255, np.uint8)
    image, pinhole = camera.undistort(white)
    assert pinhole.is_pinhole and (pinhole.width, pinhole.height) == (camera.width, camera.height)
    # black pixels would be 0; the border may lie a hundredth of a pixel outside the source
    assert image.min() >= 250


@DISTORTED
def test_undistorted_keeps_most_of_the_view(camera: Camera) -> None:
    """No black border at the price of a needlessly narrow view would be easy."""
    pinhole = camera.undistorted()
    corners = np.array([[0, 0], [639, 0], [639, 479], [0, 479]], float)
    edges = np.concatenate([np.linspace(corners[i], corners[(i + 1) % 4], 200) for i in range(4)])
    ray = np.concatenate([pinhole.normalized(edges), np.ones((len(edges), 1))], 1)
    u, v = camera.project(ray).T
    assert u.min() > -0.1 and v.min() > -0.1 and u.max() < 639.1 and v.max() < 479.1
    # the widest pinhole touches the source image's border somewhere
    slack = min(u.min(), v.min(), 639 - u.max(), 479 - v.max())
    assert slack < 2.0
    assert pinhole.fx / pinhole.fy == pytest.approx(camera.fx / camera.fy)


@DISTORTED
def test_projected_points_land_where_the_undistorted_camera_says(camera: Camera) -> None:
    """Dots drawn through the lens are found in the undistorted image at the pinhole's pixels."""
    pinhole = camera.undistorted()
    goal = np.array([[60.0, 50], [320, 60], [580, 70], [99, 240], [330, 250], [560, 400]])
    rays = np.concatenate([pinhole.normalized(goal), np.ones((len(goal), 1))], 1)
    y, x = np.mgrid[0:480, 0:640]
    image = np.zeros((480, 640))
    for u, v in camera.project(rays):
        image += 255 * np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * 2.5**2))
    flat, returned = camera.undistort(np.repeat(image[..., None].astype(np.uint8), 3, 2))
    assert returned == pinhole
    for u, v in pinhole.project(rays):
        cut = flat[round(v) - 12 : round(v) + 13, round(u) - 12 : round(u) + 13, 0].astype(float)
        yy, xx = np.mgrid[-12:13, -12:13]
        centre = [(cut * xx).sum() / cut.sum() + round(u), (cut * yy).sum() / cut.sum() + round(v)]
        assert np.allclose(centre, (u, v), atol=0.25)


def test_undistorting_keeps_a_centred_lens_centred() -> None:
    lens = Camera(480, 480, 300.0, 300.0, 239.5, 239.5, "equidistant", (0.01, 0.0, 0.0, 0.0))
    pinhole = lens.undistorted()
    assert (pinhole.cx, pinhole.cy) == (pytest.approx(239.5), pytest.approx(239.5))


def test_pinhole_is_not_touched() -> None:
    image = np.random.default_rng(0).integers(0, 255, (480, 640, 3), np.uint8)
    same, camera = PINHOLE.undistort(image)
    assert same is image and camera is PINHOLE
    zeros = Camera(640, 480, 500.0, 505.0, 321.0, 238.0, "plumb_bob", (0.0,) * 5)
    assert zeros.is_pinhole
    assert not FISHEYE_ZERO.is_pinhole  # no coefficients, yet no pinhole either


@pytest.mark.parametrize("focal", [250.0, 200.0, 150.0, 100.0])
def test_a_fisheye_wider_than_any_pinhole_is_cut(focal: float) -> None:
    """At 90 degrees from the axis a pinhole's focal length would go to zero."""
    wide = Camera(640, 480, focal, focal, 319.5, 239.5, "equidistant", (0.0,) * 4)
    pinhole = wide.undistorted()
    half_view = np.degrees(np.arctan(320 / pinhole.fx))
    assert 40 < half_view < 66
    ray = np.array([[0.9, 0.4, 1.0]])
    u, v = wide.project(ray)[0]
    x, y = pinhole.project(ray)[0]
    image = np.zeros((480, 640, 3), np.uint8)
    cv2.circle(image, (round(u), round(v)), 6, (255, 255, 255), -1)
    assert wide.undistort(image)[0][round(y), round(x)].min() == 255


def test_distortion_that_folds_the_image_is_refused() -> None:
    folded = Camera(640, 480, 99.0, 99.0, 2000.0, 240.0, "plumb_bob", (-0.5, 0.0, 0.0, 0.0))
    with pytest.raises(CameraError, match="no undistorted image"):
        folded.undistorted()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"width": 0}, "not positive"),
        ({"height": -1}, "not positive"),
        ({"fx": 0.0}, "uncalibrated"),
        ({"fy": -3.0}, "must be positive"),
        ({"cx": float("nan")}, "not finite"),
        ({"fx": float("inf")}, "not finite"),
        ({"dist": (0.1, float("nan"), 0.0, 0.0)}, "not finite"),
        ({"model": "barrel"}, "supported: plumb_bob"),
        ({"dist": (0.1, 0.2)}, "coefficients"),
        ({"model": "equidistant", "dist": (0.1,) * 5}, "coefficients"),
        ({"model": "rational_polynomial", "dist": (0.1,) * 5}, "coefficients"),
    ],
)
def test_bad_values_are_refused(change: dict[str, object], words: str) -> None:
    good = {"width": 640, "height": 480, "fx": 500.0, "fy": 500.0, "cx": 320.0, "cy": 240.0}
    Camera(**good)  # type: ignore[arg-type]
    with pytest.raises(CameraError, match=words):
        Camera(**{**good, **change})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((480, 639, 3), np.uint8),
        np.zeros((640, 480, 3), np.uint8),
        np.zeros((480, 640), np.uint8),
        np.zeros((480, 640, 4), np.uint8),
        np.zeros((480, 640, 3), np.float32),
    ],
    ids=["width", "transposed", "grey", "rgba", "float"],
)
def test_an_image_of_another_shape_is_refused(image: np.ndarray) -> None:
    with pytest.raises(CameraError, match="image"):
        PINHOLE.check_image(image)
    with pytest.raises(CameraError):
        BARREL.undistort(image)


def test_models_are_what_the_message_lists() -> None:
    assert set(MODELS) == {"plumb_bob", "rational_polynomial", "equidistant"}
