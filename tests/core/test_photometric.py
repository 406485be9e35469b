"""Direct alignment: known motions are found, and nothing is changed for the worse."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import room

from igaussian_core.camera import Camera
from igaussian_core.config import Config
from igaussian_core.gaussian_map import GaussianMap
from igaussian_core.geometry import compose, inverse, pose_error, rotation_from_vector
from igaussian_core.lifting import trusted_depth
from igaussian_core.localizer import Localizer
from igaussian_core.query import Query
from igaussian_core.refine import refiner as refiners
from igaussian_core.refine.photometric import Photometric, align_photometric
from igaussian_core.timing import StageTimer

CAMERA = Camera(480, 360, 390.0, 390.0, 239.5, 179.5)
POSES = room.query_poses(3)
SMALL = compose(rotation_from_vector([0.002, -0.0025, 0.001]), [0.002, 0.001, -0.003])  # 0.2 deg
LARGE = compose(rotation_from_vector([0.016, 0.014, -0.015]), [0.02, -0.01, 0.02])  # 1.5 deg
GREY = np.full(3, 1 / 3)


def view(gmap: GaussianMap, T_scene_cam: np.ndarray) -> tuple[Any, ...]:
    """Grey levels, depth, trusted depth."""
    rgb, depth, alpha = gmap.render(CAMERA, inverse(T_scene_cam), threads=2)
    return (255 * rgb @ GREY).astype(np.float32), depth, trusted_depth(depth, alpha, 0.8, 0.1)


def photo(
    gmap: GaussianMap, T_scene_cam: np.ndarray, gain: float = 0.7, offset: float = 20.0
) -> np.ndarray:
    grey = view(gmap, T_scene_cam)[0]
    noise = np.random.default_rng(0).normal(0, 1, grey.shape)
    return np.clip(np.rint(gain * grey + offset + noise), 0, 255).astype(np.float32)


@pytest.mark.parametrize(("motion", "levels"), [(SMALL, 1), (LARGE, 3)], ids=["small", "large"])
def test_a_known_motion_is_found_under_another_exposure(
    room_map: GaussianMap, motion: np.ndarray, levels: int
) -> None:
    for T in POSES:
        found = align_photometric(
            photo(room_map, T @ motion), *view(room_map, T), CAMERA, levels=levels
        )
        assert found is not None and found.lowered
        angle, distance = pose_error(found.T_render_cam, motion)
        assert angle < 0.02 and distance < 1e-3
        assert found.gain == pytest.approx(0.7, abs=0.02)
        assert found.offset == pytest.approx(20, abs=2)
        assert 1000 < found.pixels <= 6000 and found.step_px < 0.1


def test_it_begins_where_it_is_told(room_map: GaussianMap) -> None:
    T = POSES[1]
    found = align_photometric(photo(room_map, T @ LARGE), *view(room_map, T), CAMERA, LARGE)
    assert found is not None and pose_error(found.T_render_cam, LARGE)[0] < 0.02
    assert found.before < 3  # nothing but noise was left at the start


def test_what_the_render_does_not_show_is_passed_over(room_map: GaussianMap) -> None:
    T = POSES[0]
    image = photo(room_map, T @ SMALL)
    image[:, :160] = photo(room.room(seed=9), T)[:, :160]
    found = align_photometric(image, *view(room_map, T), CAMERA)
    assert found is not None and pose_error(found.T_render_cam, SMALL)[0] < 0.02


def test_other_evidence_weighs_as_much_as_the_pixels(room_map: GaussianMap) -> None:
    """The result lies between; what the evidence is surer of moves less."""
    T = POSES[0]
    arguments = (photo(room_map, T @ SMALL), *view(room_map, T), CAMERA)

    def aligned(covariance: list[float] | None) -> Photometric:
        C = None if covariance is None else np.diag(covariance)
        found = align_photometric(*arguments, covariance=C)
        assert found is not None and found.lowered
        return found

    alone, both = aligned(None), aligned([1e-6] * 6)
    assert both.after > alone.after
    start, there = pose_error(np.eye(4), SMALL), pose_error(both.T_render_cam, SMALL)
    assert pose_error(alone.T_render_cam, SMALL)[0] < there[0] < 0.9 * start[0]
    twice = aligned([4e-6] * 6)  # only the shape counts
    assert np.allclose(twice.T_render_cam, both.T_render_cam, atol=1e-9)
    place, turn = aligned([1e-12] * 3 + [1e-2] * 3), aligned([1e-2] * 3 + [1e-12] * 3)
    moved = [float(np.linalg.norm(f.T_render_cam[:3, 3])) for f in (place, turn)]
    turned = [pose_error(f.T_render_cam, np.eye(4))[0] for f in (place, turn)]
    assert moved[0] < moved[1] and turned[1] < turned[0]


def test_nothing_to_align(room_map: GaussianMap) -> None:
    grey, depth, trusted = view(room_map, POSES[0])
    flat = np.full_like(grey, 90.0)
    assert align_photometric(grey, flat, depth, trusted, CAMERA) is None
    assert align_photometric(grey, grey, depth, np.zeros_like(trusted), CAMERA) is None
    away = compose(rotation_from_vector([0, np.pi, 0]), np.zeros(3))
    assert align_photometric(grey, grey, depth, trusted, CAMERA, away) is None
    tiny = Camera(12, 9, 10.0, 10.0, 5.5, 4.0)
    small = np.zeros((9, 12), np.float32)
    assert align_photometric(small, small, small, small > 0, tiny) is None
    lit = align_photometric(flat, grey, depth, trusted, CAMERA)  # an image without structure
    assert lit is None or np.isfinite(lit.T_render_cam).all()


# --- in the refiner ---


def a_query(localizer: Localizer, image: np.ndarray) -> Query:
    return Query(image, room.CAMERA, localizer._matcher, 256, StageTimer())


def test_polishing_lowers_the_error(localizer: Localizer, room_map: GaussianMap) -> None:
    """Of poses that alignment found, over several views and kinds of noise."""
    refiner, errors = localizer._refiner, []
    for seed, T in enumerate(room.query_poses(8, seed=3)):
        query = a_query(localizer, room.photo(room_map, T, seed=seed))
        aligned = refiner.align(query, T @ SMALL)
        assert aligned.T_scene_cam is not None
        polished = refiner.polish(query, aligned)
        assert polished.T_scene_cam is not None
        errors.append([pose_error(r.T_scene_cam, T)[0] for r in (aligned, polished)])
        assert "polish" in query.timer.timings_ms()
    before, after = np.mean(errors, axis=0)
    assert after < before


@pytest.mark.parametrize("why", ["not lowered", "points disagree", "nothing found"])
def test_polishing_leaves_what_would_get_worse(
    why: str, localizer: Localizer, room_map: GaussianMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    query = a_query(localizer, room.photo(room_map, POSES[0]))
    aligned = localizer._refiner.align(query, POSES[0] @ SMALL)
    off = compose(rotation_from_vector([0, np.radians(0.3), 0]), np.zeros(3))  # 1.4 px

    def moved(*args: Any, **kwargs: Any) -> Photometric | None:
        if why == "nothing found":
            return None
        after = 9.0 if why == "points disagree" else 10.0
        return Photometric(off, 10.0, after, 1.0, 0.0, 1000, 0.001)

    monkeypatch.setattr(refiners, "align_photometric", moved)
    assert localizer._refiner.polish(query, aligned) is aligned


def test_it_can_be_turned_off(room_igmap: Path, room_map: GaussianMap) -> None:
    image = room.photo(room_map, POSES[0])
    found = {}
    for mode in ("off", "polish"):
        localizer = Localizer.open(room_igmap, Config.from_flat({"refine.photometric": mode}))
        found[mode] = localizer.localize(image, room.CAMERA, POSES[0] @ SMALL)
        assert ("polish" in found[mode].timings_ms) is (mode == "polish")
        assert found[mode].ok
    assert not np.allclose(found["off"].T_map_cam, found["polish"].T_map_cam, atol=1e-9)  # type: ignore[arg-type]


def test_matches_by_descriptors_are_not_polished(
    localizer: Localizer, room_map: GaussianMap
) -> None:
    """Their render may be many pixels off, and their points say less than the pixels would."""
    query = a_query(localizer, room.photo(room_map, POSES[0]))
    aligned = localizer._refiner.align(query, POSES[0] @ SMALL)
    matched = dataclasses.replace(
        aligned, evidence=dataclasses.replace(aligned.evidence, method="xfeat")
    )
    assert localizer._refiner.polish(query, matched) is matched
