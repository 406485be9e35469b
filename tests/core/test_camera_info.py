"""Camera from camera_info: binning, region of interest, refusals."""

from __future__ import annotations

import numpy as np
import pytest

from igaussian_core.camera import Camera
from igaussian_core.camera_info import camera_from_info
from igaussian_core.errors import CameraError

K = [500.0, 0, 319.5, 0, 510.0, 239.5, 0, 0, 1]
D = [0.1, -0.05, 0.001, 0.002, 0.01]


def test_plain():
    camera = camera_from_info(640, 480, K, D, "plumb_bob")
    assert camera == Camera(640, 480, 500, 510, 319.5, 239.5, "plumb_bob", tuple(D))


def test_no_distortion_whatever_the_name():
    for name in ("plumb_bob", "", "none"):
        assert camera_from_info(640, 480, K, [0.0] * 5, name).is_pinhole
        assert camera_from_info(640, 480, K, [], name).is_pinhole


def test_equidistant_zeros_stay_a_fisheye():
    assert camera_from_info(640, 480, K, [0.0] * 4, "equidistant").model == "equidistant"


def test_region_and_binning_agree_with_projection():
    full = camera_from_info(640, 480, K, D)
    part = camera_from_info(640, 480, K, D, binning=(2, 2), roi=(100, 60, 400, 300))
    assert (part.width, part.height) == (200, 150)
    point = np.array([[0.1, 0.05, 1.0]])
    expected = (full.project(point) - [100, 60] + 0.5) / 2 - 0.5
    np.testing.assert_allclose(part.project(point), expected, atol=1e-9)


def test_binning_is_resizing():
    assert camera_from_info(640, 480, K, binning=(2, 2)) == Camera(
        640, 480, 500, 510, 319.5, 239.5
    ).resized(320, 240)


def test_rectified_takes_P():
    P = [400.0, 0, 300, 0, 0, 410.0, 200, 0, 0, 0, 1, 0]
    assert camera_from_info(640, 480, K, D, P=P, rectified=True) == Camera(
        640, 480, 400, 410, 300, 200
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((640, 480, [0.0] * 9), "not calibrated"),
        ((640, 480, K[:4]), "K has 4 values, 9 wanted"),
        ((0, 0, K), "0x0 is not positive"),
        ((640, 480, K, D, "thin_prism"), "thin_prism.*supported: plumb_bob"),
        ((640, 480, K, D[:3], "plumb_bob"), "coefficients, got 3"),
        ((640, 480, K, D, "plumb_bob", (0, 0), (600, 0, 100, 100)), "not inside 640x480"),
        ((640, 480, [np.nan] * 9), "not finite"),
    ],
)
def test_refused(arguments, message):
    with pytest.raises(CameraError, match=message):
        camera_from_info(*arguments)
