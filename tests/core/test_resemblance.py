"""Which places are worth matching descriptors at."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from igaussian_core.camera import Camera
from igaussian_core.features import Features
from igaussian_core.geometry import compose
from igaussian_core.hypothesis import Hypothesis
from igaussian_core.query import Query
from igaussian_core.refine.resemblance import most_alike
from igaussian_core.timing import StageTimer

CAMERA = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
DIRECTIONS = np.eye(256, dtype=np.float32)


class GreyLevels:
    """As many of one set of descriptors as the image is bright; of another set where it is red."""

    name, min_similarity = "fake", 0.8

    def extract(self, image: NDArray[np.uint8], keypoints: int) -> Features:
        red, other, _ = image[0, 0]
        first = 0 if other else 128
        found = DIRECTIONS[first : first + min(int(red), keypoints)]
        return Features(np.zeros((len(found), 2), np.float32), found, (64, 48))

    def match(self, a: Features, b: Features) -> NDArray[np.int64]:
        raise AssertionError("neighbours are enough")


def place(x: float) -> Hypothesis:
    return Hypothesis(compose(np.eye(3), [x, 0, 0]), 1.0, "network")


def asked(places: list[Hypothesis], least: float) -> list[float]:
    def render(
        camera: Camera, T: NDArray[np.float64]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        x = abs(T[0, 3])
        rgb = np.full((48, 64, 3), x / 255, np.float32)
        rgb[..., 1] = 0.5 if T[0, 3] > 0 else 0
        return rgb, np.ones((48, 64), np.float32), np.ones((48, 64), np.float32)

    image = np.full((48, 64, 3), 120, np.uint8)
    query = Query(image, CAMERA, GreyLevels(), 200, StageTimer())
    found = most_alike(query, places, render, GreyLevels(), 200, least)
    return [float(h.T_scene_cam[0, 3]) for h in found]


def test_what_resembles_the_image_most_comes_first() -> None:
    assert asked([place(x) for x in (20, 90, 50)], least=1) == [90, 50, 20]


def test_what_hardly_resembles_it_is_left_out() -> None:
    assert asked([place(x) for x in (20, 90, -110, 40)], least=40) == [90, 40]
    assert asked([place(-110)], least=40) == [] and asked([], least=40) == []


def test_equals_stay_in_their_order() -> None:
    assert asked([place(x) for x in (125, 60, 130)], least=40) == [125, 130, 60]
