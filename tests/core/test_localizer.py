"""The whole pipeline in a small room: compile it, and localize photos at poses never rendered."""

from __future__ import annotations

import dataclasses
import json
import logging
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import room

from igaussian_core.camera import Camera
from igaussian_core.coarse.landmarks import LandmarkLocalizer
from igaussian_core.compile_map import CompileOptions, compile_map, training_images
from igaussian_core.config import Config
from igaussian_core.errors import CameraError, DatasetError, MapError
from igaussian_core.gaussian_map import GaussianMap, save_ply
from igaussian_core.geometry import (
    Sim3,
    compose,
    inverse,
    is_rigid,
    pose_error,
    rotation_from_vector,
    transform_points,
)
from igaussian_core.localizer import Localizer
from igaussian_core.map_package import open_package, with_T_map_scene
from igaussian_core.query import Query
from igaussian_core.refine.refiner import Refinement
from igaussian_core.refine.verify import Evidence
from igaussian_core.result import LocalizationResult, Status
from igaussian_core.timing import StageTimer

QUERIES = room.query_poses(6)
# two degrees and three centimetres from the truth
NUDGE = compose(rotation_from_vector([0.02, 0.025, -0.01]), [0.02, -0.01, 0.02])


def assert_right(
    result: LocalizationResult, T_true: np.ndarray, degrees: float = 0.15, metres: float = 0.004
) -> None:
    assert result.ok, f"{result.status}: {result.reason}"
    assert result.T_map_cam is not None and is_rigid(result.T_map_cam, 1e-6)
    angle, distance = pose_error(result.T_map_cam, T_true)
    assert angle < degrees and distance < metres


@pytest.fixture(scope="module")
def results(localizer: Localizer, room_map: GaussianMap) -> list[LocalizationResult]:
    """Localizations of all queries from nothing."""
    return [localizer.localize(room.photo(room_map, T), room.CAMERA) for T in QUERIES]


def test_photos_are_localized_from_nothing(results: list[LocalizationResult]) -> None:
    for result, T in zip(results, QUERIES, strict=True):
        assert_right(result, T)
        assert result.source == "landmarks" and result.matcher in ("align", "xfeat")
    errors = np.array(
        [pose_error(r.T_map_cam, T) for r, T in zip(results, QUERIES, strict=True)]  # type: ignore[arg-type]
    )
    assert np.median(errors[:, 0]) < 0.03 and np.median(errors[:, 1]) < 0.001


def test_a_track_s_small_step_takes_one_render(
    localizer: Localizer, room_map: GaussianMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And the comparison does not take the step for blur or for another place."""
    T = QUERIES[0]
    image = room.photo(room_map, T)
    still = localizer.localize(image, room.CAMERA, prior=T)
    step = compose(rotation_from_vector([0, 0.01, 0]), np.zeros(3))
    renders = []
    render = localizer._refiner._render
    monkeypatch.setattr(
        localizer._refiner, "_render", lambda *where: renders.append(where) or render(*where)
    )
    result = localizer.localize(image, room.CAMERA, prior=T @ step)
    assert_right(result, T)
    assert result.source == "prior" and len(renders) == 1
    assert result.agreement == pytest.approx(still.agreement, abs=0.02)
    assert result.sharpness == pytest.approx(still.sharpness, abs=0.1)


def test_the_evidence_is_complete(results: list[LocalizationResult]) -> None:
    for result in results:
        assert result.status in (Status.OK, Status.OK_DEGRADED) and result.reason
        assert 40 <= result.inliers <= result.matches
        assert result.inlier_ratio == pytest.approx(result.inliers / result.matches)
        assert 0 <= result.residual_px < 2
        assert 0.7 < result.coverage <= 1
        assert result.T_map_cam_coarse is not None and is_rigid(result.T_map_cam_coarse, 1e-6)
        stages = {"prepare", "extract", "coarse", "render", "solve", "total"}
        assert set(result.timings_ms) >= stages
        total = result.timings_ms["total"]
        assert (
            0
            < sum(ms for stage, ms in result.timings_ms.items() if stage != "total")
            <= 1.001 * total
        )


def test_the_covariance_is_a_covariance(results: list[LocalizationResult]) -> None:
    for result in results:
        C = result.covariance
        assert C is not None and C.shape == (6, 6)
        assert np.allclose(C, C.T) and np.linalg.eigvalsh(C).min() > 0
        sigma = np.sqrt(np.diag(C))
        assert sigma.min() > 1e-5 and sigma.max() < 0.1


def test_the_same_image_gives_the_same_pose(
    localizer: Localizer, room_map: GaussianMap, results: list[LocalizationResult]
) -> None:
    again = localizer.localize(room.photo(room_map, QUERIES[0]), room.CAMERA)
    assert np.allclose(again.T_map_cam, results[0].T_map_cam, atol=1e-6)  # type: ignore[arg-type]


def test_a_prior_is_tried_first(localizer: Localizer, room_map: GaussianMap) -> None:
    for T in QUERIES[:3]:
        result = localizer.localize(room.photo(room_map, T), room.CAMERA, T @ NUDGE)
        assert_right(result, T)
        assert result.source == "prior"
        assert np.allclose(result.T_map_cam_coarse, T @ NUDGE)  # type: ignore[arg-type]
        assert "coarse" not in result.timings_ms  # the landmarks were not asked


def test_rounding_does_not_grow_from_prior_to_prior(
    localizer: Localizer, room_map: GaussianMap
) -> None:
    rough = QUERIES[0].copy()
    rough[:3, :3] *= 1 + 2e-5  # as a pose of single precision may be
    result = localizer.localize(room.photo(room_map, QUERIES[0]), room.CAMERA, rough)
    assert_right(result, QUERIES[0])
    assert result.source == "prior" and is_rigid(result.T_map_cam, 1e-12)  # type: ignore[arg-type]


def test_a_place_too_far_off_to_align_to_is_approached(
    localizer: Localizer, room_map: GaussianMap
) -> None:
    refiner = localizer._refiner
    far = compose(rotation_from_vector([0.1, -0.2, 0.1]), [0.06, 0.05, -0.04])
    for T in QUERIES[:4]:
        query = Query(room.photo(room_map, T), room.CAMERA, localizer._matcher, 1, StageTimer())
        nearer = refiner.approach(query, T @ far)
        assert nearer is not None
        angle, distance = pose_error(nearer, T)
        assert angle < 0.5 and distance < 0.02
        backwards = compose(rotation_from_vector([0, np.pi, 0]), [0, 0, 0])
        assert refiner.approach(query, T @ backwards) is None


def test_a_prior_that_is_ten_degrees_off_is_approached(
    localizer: Localizer, room_map: GaussianMap
) -> None:
    off = compose(rotation_from_vector([0.1, -0.14, 0.05]), [0.06, 0.05, -0.04])
    for T in QUERIES[:4]:
        result = localizer.localize(room.photo(room_map, T), room.CAMERA, T @ off)
        assert_right(result, T)
        assert result.source == "prior" and result.matcher == "align"
        assert "extract" not in result.timings_ms  # descriptors would have been a last resort


def test_the_prior_itself_is_never_the_answer(localizer: Localizer, room_map: GaussianMap) -> None:
    prior = QUERIES[0] @ NUDGE
    for image in (room.photo(room_map, QUERIES[0]), noise_image()):
        result = localizer.localize(image, room.CAMERA, prior)
        if result.T_map_cam is not None:
            assert pose_error(result.T_map_cam, prior)[0] > 0.5


@pytest.mark.parametrize(
    "wrong",
    [
        compose(rotation_from_vector([0, np.pi, 0]), [0, 0, 0]),  # looks the other way
        compose(rotation_from_vector([0.5, 1.5, 0]), [0.8, 0.3, -0.5]),
        compose(np.eye(3), [500.0, 0, 0]),  # far outside of the map
    ],
    ids=["backwards", "elsewhere", "outside"],
)
def test_a_wrong_prior_is_recovered_from(
    localizer: Localizer, room_map: GaussianMap, wrong: np.ndarray
) -> None:
    T = QUERIES[2]
    result = localizer.localize(room.photo(room_map, T), room.CAMERA, T @ wrong)
    assert_right(result, T)
    assert result.source == "landmarks"


@pytest.mark.parametrize(
    "prior",
    [np.eye(3), np.full((4, 4), np.nan), 2 * np.eye(4), np.diag([1.0, 1, -1, 1]), np.zeros(7)],
    ids=["3x3", "nan", "scaled", "mirrored", "vector"],
)
def test_a_prior_that_is_no_pose_is_an_error(
    localizer: Localizer, room_map: GaussianMap, prior: np.ndarray
) -> None:
    with pytest.raises(CameraError, match="prior"):
        localizer.localize(room.photo(room_map, QUERIES[0]), room.CAMERA, prior)


def noise_image(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (240, 320, 3), np.uint8)


def smooth_noise() -> np.ndarray:
    small = np.random.default_rng(1).integers(0, 256, (30, 40, 3), np.uint8)
    return np.ascontiguousarray(cv2.resize(small, (320, 240), interpolation=cv2.INTER_CUBIC))


def checkerboard() -> np.ndarray:
    y, x = np.mgrid[0:240, 0:320]
    return np.repeat((255 * ((x // 20 + y // 20) % 2)).astype(np.uint8)[..., None], 3, 2)


NOT_THE_ROOM = {
    "black": np.zeros((240, 320, 3), np.uint8),
    "white": np.full((240, 320, 3), 255, np.uint8),
    "noise": noise_image(),
    "smooth noise": smooth_noise(),
    "checkerboard": checkerboard(),
}


@pytest.mark.parametrize("name", NOT_THE_ROOM)
@pytest.mark.parametrize("with_prior", [False, True], ids=["global", "prior"])
def test_what_is_not_the_room_is_not_accepted(
    localizer: Localizer, name: str, with_prior: bool
) -> None:
    prior = QUERIES[0] if with_prior else None
    result = localizer.localize(NOT_THE_ROOM[name], room.CAMERA, prior)
    assert not result.ok and result.T_map_cam is None and result.covariance is None
    assert result.reason and result.timings_ms["total"] > 0
    if name in ("black", "white"):
        assert result.status is Status.TOO_DARK_OR_BLURRED


def test_another_scene_is_not_accepted(localizer: Localizer) -> None:
    """A room of the same shape with other walls, even at the right prior."""
    other = room.room(seed=2)
    for T in QUERIES[:1]:
        for prior in (None, T):
            result = localizer.localize(room.photo(other, T), room.CAMERA, prior)
            assert not result.ok and result.T_map_cam is None


def test_a_mirror_image_is_not_accepted(localizer: Localizer, room_map: GaussianMap) -> None:
    for T in QUERIES[:2]:
        mirrored = np.ascontiguousarray(room.photo(room_map, T)[:, ::-1])
        assert not localizer.localize(mirrored, room.CAMERA, T).ok


def test_blur_is_named(localizer: Localizer, room_map: GaussianMap) -> None:
    """Points can still be followed when the detail is gone that a pose should rest on."""
    image = room.photo(room_map, QUERIES[0])
    found = {
        sigma: localizer.localize(
            np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), np.uint8), room.CAMERA, QUERIES[0]
        )
        for sigma in (3, 7, 14)
    }
    assert_right(found[3], QUERIES[0], degrees=0.3, metres=0.01)
    assert found[7].status is Status.TOO_DARK_OR_BLURRED and "detail" in found[7].reason
    assert found[7].T_map_cam is None and found[7].inliers > 60
    assert not found[14].ok


def test_confidence_says_what_the_verdict_says(
    localizer: Localizer, room_map: GaussianMap, results: list[LocalizationResult]
) -> None:
    wrong = [localizer.localize(image, room.CAMERA) for image in NOT_THE_ROOM.values()]
    for result in [*results, *wrong]:
        assert (result.confidence >= 0.5) is result.ok
    for result in results:
        assert result.agreement > 0.9 and result.sharpness > 0.7


def test_time_that_is_over_is_told(room_igmap: Path, room_map: GaussianMap) -> None:
    """The first place is always tried; that others were not is a status of its own."""
    hurried = Localizer.open(room_igmap, Config.from_flat({"runtime.budget_ms": 1}))
    image = room.photo(room_map, QUERIES[0])
    assert_right(hurried.localize(image, room.CAMERA, QUERIES[0] @ NUDGE), QUERIES[0])
    away = QUERIES[0] @ compose(rotation_from_vector([0, np.pi, 0]), [0, 0, 0])
    result = hurried.localize(image, room.CAMERA, away)
    assert result.status is Status.TIMEOUT and not result.ok and result.T_map_cam is None
    assert "1 ms" in result.reason and "the best" in result.reason
    assert "coarse" not in result.timings_ms  # no time was spent to find that out


def test_a_track_s_frame_matches_no_descriptors_that_would_end_too_late(
    room_igmap: Path, room_map: GaussianMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where the prior is wrong, places are still aligned to; from nothing they are matched."""
    localizer = Localizer.open(room_igmap, Config.from_flat({"runtime.budget_ms": 60000.0}))
    refiner, described = localizer._refiner, []
    before_ms = refiner.match_ms
    matched = refiner.match

    def match(query: Query, T_scene_cam: np.ndarray, near: bool = False) -> Refinement:
        described.append(near)
        return matched(query, T_scene_cam, near)

    monkeypatch.setattr(refiner, "match", match)
    nothing = Refinement(None, None, Evidence(""))
    monkeypatch.setattr(refiner, "align", lambda query, T, near=False: nothing)
    image = room.photo(room_map, QUERIES[0])
    away = QUERIES[0] @ compose(rotation_from_vector([0, np.pi, 0]), [0, 0, 0])
    assert_right(localizer.localize(image, room.CAMERA, away), QUERIES[0], degrees=0.3)
    assert described == [True, False] and refiner.match_ms != before_ms

    refiner.match_ms = 1e9
    result = localizer.localize(image, room.CAMERA, away)
    assert result.status is Status.TIMEOUT and described[2:] == [True]
    assert localizer.localize(image, room.CAMERA).ok and described[3:] == [False]


@pytest.mark.parametrize("size", [(319, 240), (240, 320), (640, 480)])
def test_an_image_of_another_size_is_an_error(localizer: Localizer, size: tuple[int, int]) -> None:
    image = np.zeros((size[1], size[0], 3), np.uint8)
    with pytest.raises(CameraError, match="320x240"):
        localizer.localize(image, room.CAMERA)


@pytest.mark.parametrize(
    "image",
    [np.zeros((240, 320), np.uint8), np.zeros((240, 320, 4), np.uint8), np.zeros((240, 320, 3))],
    ids=["grey", "rgba", "float"],
)
def test_an_image_that_is_no_rgb_is_an_error(localizer: Localizer, image: np.ndarray) -> None:
    with pytest.raises(CameraError, match="uint8 RGB"):
        localizer.localize(image, room.CAMERA)


def test_a_tiny_image_is_no_error(localizer: Localizer) -> None:
    image = np.random.default_rng(0).integers(0, 256, (9, 12, 3), np.uint8)
    assert not localizer.localize(image, Camera(12, 9, 10.0, 10.0, 5.5, 4.0)).ok


def test_a_large_image_is_shrunk_with_its_camera(
    localizer: Localizer, room_map: GaussianMap
) -> None:
    """Intrinsics of one size on an image of another would be off by far more."""
    large = room.CAMERA.resized(1500, 1125)
    result = localizer.localize(room.photo(room_map, QUERIES[3], large), large)
    assert_right(result, QUERIES[3])


@pytest.mark.parametrize(
    "lens",
    [
        Camera(320, 240, 230.0, 232.0, 163.0, 118.0, "plumb_bob", (-0.25, 0.06, 1e-3, 0.0)),
        Camera(320, 240, 200.0, 200.0, 158.0, 121.0, "equidistant", (0.01, -0.01, 0.0, 0.0)),
    ],
    ids=["plumb_bob", "fisheye"],
)
def test_distortion_is_taken_care_of(
    localizer: Localizer, room_map: GaussianMap, lens: Camera
) -> None:
    wide = Camera(960, 720, 300.0, 300.0, 479.5, 359.5)
    scene = room.photo(room_map, QUERIES[4], wide)
    v, u = np.mgrid[0:240, 0:320]
    x, y = lens.normalized(np.stack([u.ravel(), v.ravel()], 1).astype(float)).T
    pixels = wide.project(np.stack([x, y, np.ones_like(x)], 1)).reshape(240, 320, 2)
    image = cv2.remap(scene, *np.float32(np.moveaxis(pixels, 2, 0)), cv2.INTER_LINEAR)
    assert_right(localizer.localize(image, lens), QUERIES[4])


def test_exposure_does_not_matter(localizer: Localizer, room_map: GaussianMap) -> None:
    image = room.photo(room_map, QUERIES[1]).astype(float)
    for gain, offset in ((0.5, 5), (1.25, 10)):
        exposed = np.clip(gain * image + offset, 0, 255).astype(np.uint8)
        assert_right(localizer.localize(exposed, room.CAMERA), QUERIES[1])


@pytest.mark.parametrize("hindrance", ["blur", "dark", "occluded"])
def test_a_spoilt_photo_is_right_or_lost(
    localizer: Localizer, room_map: GaussianMap, hindrance: str
) -> None:
    T = QUERIES[5]
    image = room.photo(room_map, T)
    if hindrance == "blur":
        image = np.asarray(cv2.filter2D(image, -1, np.ones((1, 13)) / 13), np.uint8)
    elif hindrance == "dark":
        image = (image * 0.12).astype(np.uint8)
    else:
        image[:, :190] = room.photo(room.room(seed=9), T)[:, :190]
    assert_right(localizer.localize(image, room.CAMERA, T @ NUDGE), T, degrees=0.5, metres=0.015)
    from_nothing = localizer.localize(image, room.CAMERA)
    if from_nothing.ok:
        assert_right(from_nothing, T, degrees=0.5, metres=0.015)


S = Sim3(2.0, rotation_from_vector([0.2, -0.4, 1.0]), np.array([10.0, -5.0, 1.0]))


@pytest.fixture(scope="module")
def aligned(room_igmap: Path, tmp_path_factory: pytest.TempPathFactory) -> Localizer:
    """The room where a scene unit is two metres, in a turned and shifted map frame."""
    copy = tmp_path_factory.mktemp("aligned") / "room.igmap"
    shutil.copytree(room_igmap, copy)
    with_T_map_scene(copy, S)
    return Localizer.open(copy)


def test_poses_are_published_in_the_map_frame(
    aligned: Localizer, results: list[LocalizationResult], room_map: GaussianMap
) -> None:
    result = aligned.localize(room.photo(room_map, QUERIES[0]), room.CAMERA)
    assert_right(result, S.camera(QUERIES[0]), metres=0.008)
    assert np.allclose(result.T_map_cam, S.camera(results[0].T_map_cam), atol=1e-5)  # type: ignore[arg-type]
    # the covariance turns and grows with it: metres squared, radians unchanged
    turn = np.kron(np.diag([S.scale, 1.0]), S.rotation)
    expected = turn @ results[0].covariance @ turn.T  # type: ignore[operator]
    assert np.allclose(result.covariance, expected, rtol=1e-2, atol=1e-9)  # type: ignore[arg-type]


def test_priors_are_in_the_map_frame(aligned: Localizer, room_map: GaussianMap) -> None:
    T_map_cam = S.camera(QUERIES[1])
    image = room.photo(room_map, QUERIES[1])
    result = aligned.localize(image, room.CAMERA, T_map_cam @ NUDGE)
    assert_right(result, T_map_cam, metres=0.008)
    assert result.source == "prior"
    assert np.allclose(result.T_map_cam_coarse, T_map_cam @ NUDGE, atol=1e-9)  # type: ignore[arg-type]


def test_render_is_in_the_map_frame(aligned: Localizer, room_map: GaussianMap) -> None:
    rgb, depth, alpha = aligned.render(room.CAMERA, S.camera(QUERIES[0]))
    direct = room_map.render(room.CAMERA, inverse(QUERIES[0]))
    assert np.allclose(rgb, direct[0], atol=2e-2) and np.allclose(alpha, direct[2], atol=2e-2)
    assert np.allclose(depth, 2 * direct[1], rtol=1e-2, atol=1e-3)


def test_landmarks_rank_the_view_they_came_from_first(
    localizer: Localizer, room_igmap: Path
) -> None:
    package = open_package(room_igmap)
    landmarks, config = package.landmarks, Config()
    matcher = localizer._matcher
    coarse = LandmarkLocalizer(landmarks, config.coarse, matcher.min_similarity)
    for view in (0, 7, 15):
        w, h, *k = landmarks.intrinsics[view]
        camera = Camera(int(w), int(h), *k)
        T = landmarks.T_scene_cam[view]
        rgb, _, _ = package.gaussians.render(camera, inverse(T))
        image = np.clip(rgb * 255 + 0.5, 0, 255).astype(np.uint8)
        features = matcher.extract(image, 1024)
        ranks = coarse.rank_views(features)
        assert ranks[0] == view and sorted(ranks) == list(range(landmarks.view_count))
        first = next(coarse.hypotheses(features, camera))
        assert pose_error(first.T_scene_cam, T)[0] < 0.5 and first.source == "landmarks"


def test_landmarks_lie_on_the_walls(room_igmap: Path) -> None:
    """Lifted points are surfaces of the room, not in the air before or behind them."""
    package = open_package(room_igmap)
    points = package.landmarks.points.astype(float)
    to_walls = np.minimum(np.abs(points), np.abs(points - room.SIZE)).min(axis=1)
    on_box = np.abs(points - [2.2, 2.0, 0.3]).max(axis=1) < 0.36
    assert (to_walls[~on_box] < 0.03).mean() > 0.98
    low, high = np.array(package.manifest.bounds)
    assert np.allclose(low, 0, atol=0.05) and np.allclose(high, room.SIZE, atol=0.05)


def test_landmarks_project_into_their_view(room_igmap: Path) -> None:
    landmarks = open_package(room_igmap).landmarks
    for view in range(landmarks.view_count):
        w, h, *k = landmarks.intrinsics[view]
        part = landmarks.points[landmarks.offsets[view] : landmarks.offsets[view + 1]]
        in_cam = transform_points(inverse(landmarks.T_scene_cam[view]), part)
        assert (in_cam[:, 2] > 0).all() and len(part) >= 24
        uv = Camera(int(w), int(h), *k).project(in_cam)
        assert (uv > -1).all() and (uv < [w, h]).all()


def test_manifest_of_a_compiled_map(room_igmap: Path, room_ply: Path) -> None:
    manifest = open_package(room_igmap).manifest
    assert (manifest.name, manifest.kind, manifest.matcher) == ("room", "scene", "xfeat")
    assert manifest.source_file == room_ply.name
    assert manifest.T_map_scene == np.eye(4).tolist()


def test_an_object_with_sift(tmp_path: Path, room_map: GaussianMap) -> None:
    """No cameras, no network: the paper's views of an object, SIFT in both stages."""
    save_ply(block(), tmp_path / "block.ply")
    config = Config.from_flat({"features.matcher": "sift"})
    steps: list[tuple[str, int, int]] = []
    options = CompileOptions(kind="object", views=12, up=(0.0, 0.0, 1.0))
    package = compile_map(
        tmp_path / "block.ply", tmp_path / "block.igmap", None, options, config,
        lambda *step: steps.append(step),
    )  # fmt: skip
    assert package.manifest.matcher == "sift" and package.manifest.background == [1.0, 1.0, 1.0]
    assert {"source views", "depth check"} <= {stage for stage, _, _ in steps}
    assert all(1 <= done <= of for _, done, of in steps)
    localizer = Localizer.open(tmp_path / "block.igmap", config)
    camera = Camera(480, 360, 420.0, 420.0, 239.5, 179.5)
    T = package.landmarks.T_scene_cam[6] @ compose(
        rotation_from_vector([0.05, -0.06, 0.1]), [0.1, 0.05, 0.05]
    )
    rgb, _, _ = localizer.render(camera, T)
    result = localizer.localize(np.clip(rgb * 255, 0, 255).astype(np.uint8), camera)
    assert_right(result, T, degrees=0.2, metres=0.01)
    assert result.matcher in ("align", "sift")
    with pytest.raises(MapError, match="compiled with sift"):
        Localizer.open(tmp_path / "block.igmap")


def block() -> GaussianMap:
    """A textured cube of 1 m: the outside of a small room."""
    rng = np.random.default_rng(3)
    x, y, z = np.eye(3)
    o = np.zeros(3)
    sides = [(o, x, y), (z, x, y), (o, x, z), (y, x, z), (o, y, z), (x, y, z)]
    parts = [room.plane(rng, *side, 45.0) for side in sides]
    means, quats, colours = (np.concatenate(column) for column in zip(*parts, strict=True))
    return GaussianMap(
        means.astype(np.float32), quats.astype(np.float32),
        np.tile(np.array([0.011, 0.011, 1e-3], np.float32), (len(means), 1)),
        np.full(len(means), 0.97, np.float32),
        ((colours - 0.5) / room.SH0)[:, None].astype(np.float32),
    )  # fmt: skip


def no_gaussians() -> GaussianMap:
    full = room.room(0, per_metre=2)
    parts = (full.means, full.quats_wxyz, full.scales, full.opacities, full.sh)
    return GaussianMap(*(part[:0] for part in parts))


def test_unusable_input_leaves_the_target_alone(tmp_path: Path, room_ply: Path) -> None:
    target = tmp_path / "room.igmap"
    with pytest.raises(MapError, match="no such file"):
        compile_map(tmp_path / "absent.ply", target)
    with pytest.raises(MapError, match="kind 'room' is none of object, scene"):
        compile_map(room_ply, target, None, CompileOptions(kind="room"))
    with pytest.raises(DatasetError):
        compile_map(room_ply, target, tmp_path / "absent.json")
    with pytest.raises(DatasetError):
        compile_map(room_ply, target, tmp_path)
    save_ply(no_gaussians(), tmp_path / "empty.ply")
    with pytest.raises(MapError, match="no Gaussian"):
        compile_map(tmp_path / "empty.ply", target)
    assert not target.exists()


def test_a_map_that_shows_nothing_is_refused(tmp_path: Path, room_map: GaussianMap) -> None:
    """Gaussians too faint for any depth to be trusted."""
    faint = dataclasses.replace(room_map, opacities=np.full_like(room_map.opacities, 0.02))
    save_ply(faint, tmp_path / "faint.ply")
    cameras = room.write_poses(tmp_path / "poses.json", room.source_poses()[:3])
    with pytest.raises(MapError, match="no source view"):
        compile_map(tmp_path / "faint.ply", tmp_path / "faint.igmap", cameras)
    assert not (tmp_path / "faint.igmap").exists()


def test_held_out_photos_are_not_compiled(tmp_path: Path) -> None:
    cameras = room.write_poses(tmp_path / "poses.json", room.source_poses())
    source = tmp_path / "map.ply"
    assert len(training_images(source, cameras)) == 18
    (tmp_path / "map.json").write_text(json.dumps({"trained_on": ["1.png", "3.png", "x.png"]}))
    assert [i.name for i in training_images(source, cameras)] == ["1.png", "3.png"]
    (tmp_path / "map.json").write_text("[")
    with pytest.raises(MapError, match=r"map\.json"):
        training_images(source, cameras)


def test_missing_weights_are_told(
    room_igmap: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A map of XFeat landmarks cannot be used with SIFT: an error, no silent failure."""
    from igaussian_core import features

    def gone(name: str) -> None:
        raise features.WeightsError(f"{name}: not installed")

    monkeypatch.setattr(features, "_read_weights", gone)
    with caplog.at_level(logging.WARNING), pytest.raises(MapError, match="xfeat"):
        Localizer.open(room_igmap)
    assert "not installed" in caplog.text
