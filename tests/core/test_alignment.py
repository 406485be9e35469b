"""Following points of a render into an image, and the images that are compared."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from igaussian_core.camera import Camera
from igaussian_core.contrast import normalize_contrast
from igaussian_core.features import Features
from igaussian_core.query import Query
from igaussian_core.refine.alignment import Followed, corners, follow, follow_corners
from igaussian_core.timing import StageTimer


def texture(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    image = np.full((240, 320, 3), 128.0)
    for cell in (5, 12, 40):
        noise = rng.uniform(-50, 50, (240 // cell, 320 // cell, 3))
        image += cv2.resize(noise, (320, 240), interpolation=cv2.INTER_CUBIC)
    return np.clip(image, 0, 255).astype(np.uint8)


def moved(image: np.ndarray, dx: float, dy: float) -> np.ndarray:
    M = np.array([[1, 0, dx], [0, 1, dy]], float)
    return cv2.warpAffine(
        image, M, (320, 240), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
    )


def tracked(
    render: np.ndarray, image: np.ndarray, levels: int = 2, guess: tuple[float, float] = (0, 0)
) -> tuple[np.ndarray, np.ndarray]:
    """Displacements of trusted points well inside, and the share of points trusted."""
    a, b = normalize_contrast(render), normalize_contrast(image)
    mask = np.zeros(a.shape, bool)
    mask[30:-30, 30:-30] = True
    uv, _ = corners(a, mask, 200)
    found, good = follow(a, b, uv, uv + np.float32(guess), 15, levels)
    return (found - uv)[good], good.mean()


@pytest.mark.parametrize(("dx", "dy"), [(0, 0), (0.3, -0.4), (2, 0), (3.4, 5.7), (-9.5, 6.25)])
def test_a_shift_is_found_to_a_tenth_of_a_pixel(dx: float, dy: float) -> None:
    image = texture()
    motion, share = tracked(image, moved(image, dx, dy))
    assert share > 0.85 and len(motion) > 80
    assert np.abs(np.median(motion, axis=0) - [dx, dy]).max() < 0.1
    assert (np.linalg.norm(motion - [dx, dy], axis=1) < 0.2).mean() > 0.9


def test_exposure_colour_and_vignetting_do_not_matter() -> None:
    image = texture()
    y, x = np.mgrid[-1:1:240j, -1:1:320j]
    shade = (1 - 0.4 * (x * x + y * y))[..., None]
    other = np.clip(moved(image, 1.5, -0.8) * shade * [0.8, 0.6, 0.7] + 12, 0, 255)
    motion, share = tracked(image, other.astype(np.uint8))
    assert share > 0.7
    assert np.abs(np.median(motion, axis=0) - [1.5, -0.8]).max() < 0.1


def test_a_guess_bridges_a_large_motion() -> None:
    image = texture()
    motion, share = tracked(image, moved(image, 24, -18), levels=0, guess=(22.5, -17))
    assert share > 0.8
    assert np.abs(np.median(motion, axis=0) - [24, -18]).max() < 0.1


def test_another_image_is_mostly_not_trusted() -> None:
    motion, share = tracked(texture(1), texture(2))
    assert share < 0.45
    if len(motion) > 3:  # and what is trusted by chance does not agree
        assert motion.std(axis=0).max() > 1.0


def test_corners_are_inside_the_mask_and_spread() -> None:
    gray = normalize_contrast(texture())
    mask = np.zeros(gray.shape, bool)
    mask[40:200, 100:300] = True
    uv, _ = corners(gray, mask, 100)
    assert uv.dtype == np.float32 and 30 < len(uv) <= 100
    assert mask[uv[:, 1].astype(int), uv[:, 0].astype(int)].all()
    gaps = np.linalg.norm(uv[:, None] - uv[None], axis=2) + 1e3 * np.eye(len(uv))
    assert gaps.min() >= 4.0


def bare_wall(seed: int) -> np.ndarray:
    """Faint shades and one poster."""
    shades = np.random.default_rng(seed).uniform(-3, 3, (12, 16, 3))
    image = 128 + cv2.resize(shades, (320, 240), interpolation=cv2.INTER_CUBIC)
    image = np.clip(image, 0, 255).astype(np.uint8)
    for row in range(92, 150, 14):
        cv2.putText(image, "XII", (130, row), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (20, 20, 20), 2)
    return image


def followed(render: np.ndarray, image: np.ndarray) -> Followed:
    everywhere = np.ones(render.shape[:2], bool)
    a, b = normalize_contrast(render), normalize_contrast(image)
    return follow_corners(a, b, everywhere, 200, 15, 2)


def test_a_bare_wall_counts_beside_a_poster() -> None:
    """Its faint shades are followed; those that are not found do not speak against the place."""
    wall = bare_wall(0)
    uv, distinct = corners(normalize_contrast(wall), np.ones((240, 320), bool), 200)
    away = np.linalg.norm(uv - [150, 120], axis=1) > 60
    assert 0 < distinct < 20 and not away[:distinct].any() and away.sum() > 60
    same = followed(wall, moved(wall, 2.0, 1.0))
    assert len(same.uv_render) > 60
    motion = same.uv_image - same.uv_render
    assert (np.linalg.norm(motion - [2, 1], axis=1) < 0.5).mean() > 0.8


def test_noise_and_other_shades_are_not_taken_for_a_bare_wall() -> None:
    wall = bare_wall(0)
    noise = np.random.default_rng(1).normal(0, 6, wall.shape)
    noisy = np.clip(wall + noise, 0, 255).astype(np.uint8)
    for other in (noisy, bare_wall(1)):
        found = followed(wall, other)
        away = np.linalg.norm(found.uv_render - [150, 120], axis=1) > 60
        assert away.sum() < 25 and found.looked_at < 60
        assert found.looked_at >= len(found.uv_render)


def test_nothing_to_follow() -> None:
    gray = normalize_contrast(texture())
    none, _ = corners(gray, np.zeros(gray.shape, bool), 50)
    assert none.shape == (0, 2)
    found, good = follow(gray, gray, none, none, 15, 2)
    assert found.shape == (0, 2) and good.shape == (0,)
    flat = normalize_contrast(np.full((240, 320, 3), 90, np.uint8))
    assert len(corners(flat, np.ones(flat.shape, bool), 50)[0]) == 0


def test_normalized_contrast() -> None:
    image = texture()
    gray = normalize_contrast(image)
    assert gray.dtype == np.uint8 and gray.shape == (240, 320)
    assert abs(gray.mean() - 128) < 5 and 25 < gray.std() < 45
    darker = normalize_contrast((image * 0.6).astype(np.uint8)).astype(float)
    assert np.abs(darker - gray).mean() < 6
    black = normalize_contrast(np.zeros((240, 320, 3), np.uint8))
    assert (black == 128).all()  # noise of nothing is not amplified


class CountingMatcher:
    """Counts how often it is asked."""

    name = "fake"
    min_similarity = 0.5

    def __init__(self) -> None:
        self.asked: list[int] = []

    def extract(self, image: np.ndarray, keypoints: int) -> Features:
        self.asked.append(keypoints)
        return Features(np.zeros((0, 2), np.float32), np.zeros((0, 8), np.float32), (320, 240))

    def match(self, a: Features, b: Features) -> np.ndarray:
        return np.zeros((0, 2), np.int64)


def test_a_query_computes_once_and_only_when_asked() -> None:
    """Tracking by alignment never pays for keypoints."""
    matcher, timer = CountingMatcher(), StageTimer()
    query = Query(texture(), Camera(320, 240, 260.0, 260.0, 159.5, 119.5), matcher, 77, timer)
    assert np.array_equal(query.gray, normalize_contrast(texture()))
    assert matcher.asked == []
    assert query.features is query.features
    assert matcher.asked == [77] and "extract" in timer.timings_ms()
