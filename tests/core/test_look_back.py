"""A network's answer, corrected by what it says of a render from there."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from igaussian_core.camera import Camera
from igaussian_core.coarse.look_back import exposed, looked_back
from igaussian_core.geometry import compose, pose_error, rotation_from_vector

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

CAMERA = Camera(128, 96, 100.0, 100.0, 63.5, 47.5)
TRUTH = compose(rotation_from_vector([0.3, -0.2, 0.1]), [1.0, -2.0, 0.5])
IMAGE = np.full((CAMERA.height, CAMERA.width, 3), 40, np.uint8)


class Erring:
    """A network that errs, and a renderer that says what it was asked for."""

    def __init__(self, bias: list[float]) -> None:
        self.shown: list[Array] = []
        self.cameras: list[Camera] = []
        self._bias = np.array(bias)

    def render(self, camera: Camera, T_scene_cam: Array) -> tuple[NDArray[np.float32], ...]:
        self.shown.append(T_scene_cam)
        self.cameras.append(camera)
        return (np.full((camera.height, camera.width, 3), 0.3, np.float32),)

    def of(self, T_scene_cam: Array) -> Array:
        """Off by what changes a little from place to place."""
        move = self._bias[3:] * (1 + 0.2 * T_scene_cam[0, 3])
        return T_scene_cam @ compose(rotation_from_vector(self._bias[:3]), move)

    def tell(self, image: Image) -> Array:
        """Of the last render."""
        return self.of(self.shown[-1])


@pytest.mark.parametrize("renders", [1, 2])
def test_an_error_that_the_network_makes_of_the_render_as_well_is_taken_back(
    renders: int,
) -> None:
    network = Erring([0.03, -0.02, 0.01, 0.05, 0.1, -0.08])
    first = network.of(TRUTH)
    found = looked_back(IMAGE, CAMERA, first, network.tell, network.render, renders, 3.0)
    angle, distance = pose_error(found, TRUTH)
    was_angle, was_distance = pose_error(first, TRUTH)
    assert len(network.shown) == renders
    assert angle < 0.1 * was_angle and distance < 0.1 * was_distance
    # rendered larger than the network sees it, in the same proportions
    assert all(c.width > CAMERA.width and c.width * 3 == c.height * 4 for c in network.cameras)


@pytest.mark.parametrize("bias", [[0.6, 0, 0, 0, 0, 0], [0, 0, 0, 2.0, 0, 0]])
def test_what_a_network_says_that_knows_nothing_of_the_place_is_left_alone(
    bias: list[float]
) -> None:
    network = Erring(bias)
    first = network.of(TRUTH)
    found = looked_back(IMAGE, CAMERA, first, network.tell, network.render, 2, 3.0)
    assert np.array_equal(found, first) and len(network.shown) == 1


def test_a_render_gets_the_exposure_and_white_balance_of_an_image() -> None:
    rng = np.random.default_rng(0)
    coarse = rng.integers(40, 140, (12, 16, 3)).astype(np.uint8)
    render = np.kron(coarse, np.ones((8, 8, 1))).astype(np.uint8)
    image = np.clip(render * np.array([0.8, 1.0, 1.4]), 0, 255).astype(np.uint8)
    image[:30, :40] = 255  # something bright that the map does not know
    found = exposed(render, image)
    assert found.shape == render.shape and found.dtype == np.uint8
    seen = np.s_[40:, 50:]
    assert np.abs(found[seen].astype(int) - image[seen]).mean() < 3


@pytest.mark.parametrize("grey", [0, 255])
def test_images_that_tell_no_exposure_leave_the_render_as_it_is(grey: int) -> None:
    render = np.random.default_rng(1).integers(0, 255, (96, 128, 3), dtype=np.uint8)
    assert np.array_equal(exposed(render, np.full_like(render, grey)), render)
