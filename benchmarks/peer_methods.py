"""Other ways to localize, behind the interface of `Localizer.localize`.

Each is given the same reference views of a scene (training photos, or renders of the map), the
map where it needs one, and nothing else; none can be given the truth.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import poselib
import torch
from numpy.typing import ArrayLike, NDArray

from igaussian_core.camera import Camera
from igaussian_core.coarse.landmarks import LandmarkLocalizer
from igaussian_core.config import Config
from igaussian_core.evaluate.coarse_estimator import CoarseOnly
from igaussian_core.features import Features, Matcher, make_matcher
from igaussian_core.geometry import compose, inverse
from igaussian_core.lifting import at_pixels, sample, trusted_depth
from igaussian_core.localizer import network_of, render_scene
from igaussian_core.map_package import MapPackage
from igaussian_core.query import Query
from igaussian_core.refine.refiner import Refinement, Refiner
from igaussian_core.refine.verify import judge
from igaussian_core.render.torch_op import render as differentiable_render
from igaussian_core.result import LocalizationResult, Status
from igaussian_core.timing import StageTimer

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
_NO_PLACE = LocalizationResult(Status.NO_HYPOTHESIS, "too few matches with any reference view")


@dataclass(frozen=True)
class Reference:
    """A view of the scene with a known pose: pinhole image, and the map's depth there."""

    image: Image
    camera: Camera
    T_scene_cam: Array
    depth: NDArray[np.float32]
    trusted: NDArray[np.bool_]


def reference_of_map(package: MapPackage, view: int, config: Config) -> Reference:
    """The map's own source view, rendered."""
    width, height, fx, fy, cx, cy = map(float, package.landmarks.intrinsics[view])
    camera = Camera(int(width), int(height), fx, fy, cx, cy)
    T = package.landmarks.T_scene_cam[view]
    rgb, depth, trusted = _rendered(package, camera, T, config)
    return Reference(np.asarray(np.clip(rgb * 255 + 0.5, 0, 255), np.uint8), camera, T, depth,
                     trusted)  # fmt: skip


def reference_of_photo(
    package: MapPackage, image: Image, camera: Camera, T_scene_cam: Array, config: Config
) -> Reference:
    """A training photo, undistorted, with the map's depth at its pose."""
    image, camera = shrunk(image, camera, config)
    _, depth, trusted = _rendered(package, camera, T_scene_cam, config)
    return Reference(image, camera, T_scene_cam, depth, trusted)


def _rendered(package: MapPackage, camera: Camera, T_scene_cam: Array, config: Config) -> Any:
    rgb, depth, alpha = render_scene(package, camera, T_scene_cam, config.runtime.threads)
    refine = config.refine
    return rgb, depth, trusted_depth(depth, alpha, refine.min_alpha, refine.max_depth_step)


def shrunk(image: Image, camera: Camera, config: Config) -> tuple[Image, Camera]:
    """As the localizer prepares a frame."""
    small = camera.scaled_to_fit(config.image.max_side)
    size = (small.width, small.height)
    return small.undistort(np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA)))


def _answer(
    package: MapPackage, T_scene_cam: Array | None, inliers: int, timer: StageTimer, source: str
) -> LocalizationResult:
    if T_scene_cam is None:
        return LocalizationResult(
            _NO_PLACE.status, _NO_PLACE.reason, source=source, timings_ms=timer.timings_ms()
        )
    return LocalizationResult(
        Status.OK, "", package.T_map_scene.camera(T_scene_cam), inliers=inliers, source=source,
        timings_ms=timer.timings_ms(),
    )  # fmt: skip


# --- structure from motion ---


class SfmSift:
    """COLMAP through pycolmap: SIFT of the reference views, matched with their neighbours,
    triangulated at the known poses; a query's SIFT is matched with every view's points, and
    LO-RANSAC PnP over the ten best views' matches registers it."""

    _KEYPOINTS, _NEIGHBOURS, _BEST_VIEWS, _RATIO = 2048, 12, 10, 0.8
    _MAX_ERROR_PX, _MIN_INLIERS = 6.0, 15

    def __init__(
        self, package: MapPackage, references: Sequence[Reference], config: Config
    ) -> None:
        import pycolmap

        pycolmap.logging.minloglevel = 2  # errors
        self._colmap: Any = pycolmap
        self._package, self._config = package, config
        options = pycolmap.FeatureExtractionOptions()
        options.sift.max_num_features = self._KEYPOINTS
        options.num_threads, options.use_gpu = config.runtime.threads, False
        self._extractor = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
        with tempfile.TemporaryDirectory() as folder:
            self._views = self._mapped(Path(folder), references, options)

    def localize(
        self, image: Image, camera: Camera, prior: ArrayLike | None = None
    ) -> LocalizationResult:
        timer = StageTimer()
        image, camera = shrunk(image, camera, self._config)
        with timer("extract"):
            gray = np.ascontiguousarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
            found, raw = self._extractor.extract(self._colmap.Bitmap.from_array(gray))
            uv = _keypoint_array(found)
            descriptors = _unit(np.asarray(raw.data))
        with timer("match"):
            matched = [self._match(descriptors, view) for view in self._views]
            best = sorted(range(len(matched)), key=lambda i: -len(matched[i]))[: self._BEST_VIEWS]
            pairs = [(matched[i], self._views[i][1]) for i in best]
            query = np.concatenate([m[:, 0] for m, _ in pairs])
            points = np.concatenate([p[m[:, 1]] for m, p in pairs])
        with timer("solve"):
            T, inliers = self._solved(camera, uv[query], points)
        return _answer(self._package, T, inliers, timer, "sfm")

    def _solved(self, camera: Camera, uv: Array, points: Array) -> tuple[Array | None, int]:
        if len(uv) < self._MIN_INLIERS:
            return None, 0
        options = self._colmap.AbsolutePoseEstimationOptions()
        options.ransac.max_error = self._MAX_ERROR_PX
        options.ransac.random_seed = 0
        answer = self._colmap.estimate_and_refine_absolute_pose(
            uv, points, _colmap_camera(self._colmap, camera), options
        )
        if answer is None or answer["num_inliers"] < self._MIN_INLIERS:
            return None, 0
        T_cam_scene = np.vstack([answer["cam_from_world"].matrix(), [0, 0, 0, 1]])
        return inverse(T_cam_scene), int(answer["num_inliers"])

    def _match(self, descriptors: NDArray[np.float32], view: Any) -> NDArray[np.int64]:
        theirs, _ = view
        if len(theirs) < 2 or len(descriptors) < 2:
            return np.zeros((0, 2), np.int64)
        similarity = torch.from_numpy(descriptors) @ torch.from_numpy(theirs).T
        two, index = similarity.topk(2, dim=1)
        distance = (2 - 2 * two).clamp(min=0).sqrt()
        mutual = similarity.argmax(0)[index[:, 0]] == torch.arange(len(descriptors))
        keep = (mutual & (distance[:, 0] < self._RATIO * distance[:, 1])).nonzero()[:, 0]
        return np.asarray(torch.stack([keep, index[keep, 0]], 1))

    def _mapped(self, folder: Path, references: Sequence[Reference], options: Any) -> list[Any]:
        """(descriptors [N, 128], points [N, 3]) of each view's triangulated keypoints."""
        colmap, database = self._colmap, folder / "database.db"
        names = [f"{i:04d}.png" for i in range(len(references))]
        for name, reference in zip(names, references, strict=True):
            cv2.imwrite(str(folder / name), reference.image[..., ::-1])
        colmap.extract_features(
            database, folder, names, colmap.CameraMode.PER_IMAGE, extraction_options=options,
            device=colmap.Device.cpu,
        )  # fmt: skip
        pairs = folder / "pairs.txt"
        pairs.write_text("\n".join(f"{names[i]} {names[j]}" for i, j in self._pairs(references)))
        matching = colmap.FeatureMatchingOptions()
        matching.use_gpu, matching.num_threads = False, options.num_threads
        pairing = colmap.ImportedPairingOptions()
        pairing.match_list_path = pairs
        colmap.match_image_pairs(database, matching, pairing, device=colmap.Device.cpu)
        with colmap.Database.open(database) as opened:
            scene = self._known_poses(opened, references)
            descriptors = {
                image.image_id: _unit(np.asarray(opened.read_descriptors(image.image_id).data))
                for image in opened.read_all_images()
            }
        scene = colmap.triangulate_points(scene, database, folder, folder)
        views = []
        for image_id, image in scene.images.items():
            seen = [i for i, p in enumerate(image.points2D) if p.has_point3D()]
            points = [scene.points3D[image.points2D[i].point3D_id].xyz for i in seen]
            views.append((descriptors[image_id][seen], np.array(points).reshape(-1, 3)))
        return views

    def _known_poses(self, database: Any, references: Sequence[Reference]) -> Any:
        colmap, scene = self._colmap, self._colmap.Reconstruction()
        for image in database.read_all_images():
            reference = references[int(image.name[:4])]
            camera = _colmap_camera(colmap, reference.camera)
            camera.camera_id = image.camera_id
            scene.add_camera_with_trivial_rig(camera)
            keypoints = database.read_keypoints(image.image_id)[:, :2].astype(float)
            new = colmap.Image(image.name, keypoints, image.camera_id, image.image_id)
            T_cam_scene = inverse(reference.T_scene_cam)
            scene.add_image_with_trivial_frame(new, colmap.Rigid3d(T_cam_scene[:3]))
            database.update_camera(camera)
        return scene

    def _pairs(self, references: Sequence[Reference]) -> list[tuple[int, int]]:
        """Every view with those that look most alike by pose."""
        T = np.array([r.T_scene_cam for r in references])
        depth = np.median([np.median(r.depth[r.depth > 0]) for r in references if r.depth.any()])
        pairs = set()
        for i in range(len(T)):
            cosine = np.clip(T[:, :3, 2] @ T[i, :3, 2], -1, 1)
            cost = np.linalg.norm(T[:, :3, 3] - T[i, :3, 3], axis=1) / depth + np.arccos(cosine)
            for j in np.argsort(cost)[1 : self._NEIGHBOURS + 1]:
                pairs.add((min(i, int(j)), max(i, int(j))))
        return sorted(pairs)


def _colmap_camera(colmap: Any, camera: Camera) -> Any:
    return colmap.Camera(
        model="PINHOLE", width=camera.width, height=camera.height,
        params=[camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5],
    )  # fmt: skip


def _keypoint_array(keypoints: Any) -> Array:
    """[N, 2], counted from the image's corner."""
    return np.array([(k.x, k.y) for k in keypoints], np.float64).reshape(-1, 2)


def _unit(descriptors: NDArray[Any]) -> NDArray[np.float32]:
    values = descriptors.astype(np.float32)
    return values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-9)


# --- essential matrix ---


class EssentialMatrix:
    """Rotation and direction by the essential matrix with the reference view that matches
    best; the translation's length by the map's depth there: the median ratio of rendered and
    triangulated depth over the inliers."""

    _MAX_ERROR_PX, _MIN_INLIERS = 1.5, 15

    def __init__(
        self, package: MapPackage, references: Sequence[Reference], config: Config
    ) -> None:
        self._package, self._references, self._config = package, references, config
        self._matcher: Matcher = make_matcher(config.features)
        self._count = config.features.keypoints
        self._features = [self._matcher.extract(r.image, self._count) for r in references]

    def localize(
        self, image: Image, camera: Camera, prior: ArrayLike | None = None
    ) -> LocalizationResult:
        timer = StageTimer()
        image, camera = shrunk(image, camera, self._config)
        with timer("extract"):
            features = self._matcher.extract(image, self._count)
        with timer("retrieve"):
            counts = [_mutual(features, other) for other in self._features]
            nearest = int(np.argmax(counts))
        with timer("match"):
            pairs = self._matcher.match(features, self._features[nearest])
        with timer("solve"):
            T, inliers = self._solved(features, camera, nearest, pairs)
        return _answer(self._package, T, inliers, timer, "essential")

    def _solved(
        self, features: Features, camera: Camera, nearest: int, pairs: NDArray[np.int64]
    ) -> tuple[Array | None, int]:
        reference = self._references[nearest]
        if len(pairs) < self._MIN_INLIERS:
            return None, 0
        ours = features.uv[pairs[:, 0]].astype(np.float64)
        theirs = self._features[nearest].uv[pairs[:, 1]]
        options = {"max_epipolar_error": self._MAX_ERROR_PX, "seed": 0, "max_iterations": 5000}
        pose, info = poselib.estimate_relative_pose(
            theirs.astype(np.float64), ours, _poselib_camera(reference.camera),
            _poselib_camera(camera), options, {},
        )  # fmt: skip
        inliers = np.array(info["inliers"], bool)
        if inliers.sum() < self._MIN_INLIERS:
            return None, 0
        T_query_ref = compose(pose.R, pose.t)
        near = _triangulated_depth(
            T_query_ref, _rays(reference.camera, theirs), _rays(camera, ours)
        )
        use = inliers & at_pixels(reference.trusted, theirs) & (near > 0)
        if not use.any():
            return None, 0
        T_query_ref[:3, 3] *= np.median(sample(reference.depth, theirs)[use] / near[use])
        return reference.T_scene_cam @ inverse(T_query_ref), int(inliers.sum())


def _mutual(a: Features, b: Features, count: int = 512) -> int:
    """Mutual nearest neighbours of the best keypoints."""
    if len(a) < 2 or len(b) < 2:
        return 0
    s = torch.from_numpy(a.descriptors[:count]) @ torch.from_numpy(b.descriptors[:count]).T
    value, best = s.max(1)
    return int(((s.argmax(0)[best] == torch.arange(len(best))) & (value > 0.82)).sum())


def _rays(camera: Camera, uv: NDArray[Any]) -> Array:
    x = (uv[:, 0] - camera.cx) / camera.fx
    y = (uv[:, 1] - camera.cy) / camera.fy
    return np.stack([x, y, np.ones_like(x)], 1).astype(np.float64)


def _triangulated_depth(T_b_a: Array, rays_a: Array, rays_b: Array) -> Array:
    """Depth z [N] in camera a of the points nearest to both rays; not positive where behind."""
    turned = rays_a @ T_b_a[:3, :3].T
    # z_b * ray_b = z_a * turned + t, least squares in (z_a, z_b)
    a11, a12, a22 = (turned**2).sum(1), -(turned * rays_b).sum(1), (rays_b**2).sum(1)
    b1, b2 = -(turned @ T_b_a[:3, 3]), rays_b @ T_b_a[:3, 3]
    determinant = np.maximum(a11 * a22 - a12**2, 1e-12)
    z_a = (a22 * b1 - a12 * b2) / determinant
    z_b = (a11 * b2 - a12 * b1) / determinant
    return np.where(z_b > 0, z_a, -1.0)


def _poselib_camera(camera: Camera) -> dict[str, object]:
    return {"model": "PINHOLE", "width": camera.width, "height": camera.height,
            "params": [camera.fx, camera.fy, camera.cx, camera.cy]}  # fmt: skip


# --- render, compare, refine ---


class GradientDescent:
    """Adam on the six numbers of a pose against the photometric error of a differentiable
    render, coarse to fine, as iNeRF and iComMa do (the latter with a matching term on top);
    started at the prior, or at our landmarks' hypothesis. Unlike theirs it fits gain and offset
    of each colour channel at every step, without which the paper's colour changes defeat it.

    The best of the poses by the error at the finer resolution is the answer: there is no
    evidence by which it could be refused.
    """

    # longer image side; step in radians and in shares of the median depth, falls to a twentieth
    _LEVELS = ((120, 0.02), (240, 0.005))

    def __init__(self, package: MapPackage, config: Config, start: str, steps: int) -> None:
        self._steps = steps
        g = package.gaussians
        arrays = (g.means, g.quats_wxyz, g.scales, g.opacities, g.sh)
        self._map = [torch.from_numpy(np.ascontiguousarray(a, np.float32)) for a in arrays]
        self._package, self._config, self._start = package, config, start
        self._coarse = CoarseOnly(package, config)

    def localize(
        self, image: Image, camera: Camera, prior: ArrayLike | None = None
    ) -> LocalizationResult:
        timer = StageTimer()
        T = None
        if self._start == "prior":
            assert prior is not None
            T = self._package.T_map_scene.inverse().camera(prior)
        else:
            with timer("coarse"):
                found = self._coarse.localize(image, camera).T_map_cam
            T = None if found is None else self._package.T_map_scene.inverse().camera(found)
        image, camera = shrunk(image, camera, self._config)
        if T is not None:
            with timer("descend"):
                for side, rate in self._LEVELS:
                    T = self._descended(image, camera.scaled_to_fit(side), T, rate)
        return _answer(self._package, T, 0, timer, self._start)

    def _descended(
        self, image: Image, camera: Camera, T_scene_cam: Array, rate: float
    ) -> Array:
        steps = self._steps // len(self._LEVELS)
        size = (camera.width, camera.height)
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        wanted = torch.from_numpy(small.astype(np.float32) / 255)
        T_start = torch.from_numpy(inverse(T_scene_cam))
        length = self._depth(camera, T_scene_cam)
        twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
        adam = torch.optim.Adam([twist], lr=rate)
        fall = torch.optim.lr_scheduler.ExponentialLR(adam, 0.05 ** (1 / steps))
        red, green, blue = self._package.manifest.background
        best, best_T = np.inf, T_start
        for _ in range(steps):
            T = _exponential(twist, length) @ T_start
            rgb, _, _ = differentiable_render(
                *self._map, camera, T, background=(red, green, blue),
                antialiased=self._package.gaussians.antialiased,
            )  # fmt: skip
            loss = (_exposed(rgb, wanted) - wanted).abs().mean()
            if loss.item() < best:
                best, best_T = loss.item(), T.detach()
            adam.zero_grad()
            loss.backward()
            adam.step()
            fall.step()
        return inverse(best_T.numpy())

    def _depth(self, camera: Camera, T_scene_cam: Array) -> float:
        _, depth, alpha = render_scene(
            self._package, camera, T_scene_cam, self._config.runtime.threads
        )
        seen = depth[alpha > 0.5]
        return float(np.median(seen)) if len(seen) else 1.0


def _exposed(rgb: torch.Tensor, wanted: torch.Tensor) -> torch.Tensor:
    """A render [H, W, 3] with the gain and offset of each channel that bring it nearest."""
    with torch.no_grad():
        centred = rgb - rgb.mean((0, 1))
        gain = (centred * (wanted - wanted.mean((0, 1)))).sum((0, 1))
        gain = (gain / centred.square().sum((0, 1)).clamp(min=1e-9)).clamp(0.2, 5)
        offset = wanted.mean((0, 1)) - gain * rgb.mean((0, 1))
    return gain * rgb + offset


def _exponential(twist: torch.Tensor, length: float) -> torch.Tensor:
    """The rigid motion of a rotation vector and a translation in units of `length`."""
    x, y, z = twist[:3]
    zero = torch.zeros((), dtype=twist.dtype)
    K = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    top = torch.cat([torch.linalg.matrix_exp(K), length * twist[3:, None]], 1)
    return torch.cat([top, torch.tensor([[0.0, 0, 0, 1]], dtype=twist.dtype)])


# --- parts of our own pipeline ---


class Staged:
    """Stage one, then one part of stage two on its best hypothesis; judged as ours is."""

    def __init__(
        self,
        package: MapPackage,
        config: Config,
        refine: Callable[[Refiner, Query, Array], Refinement],
    ) -> None:
        self._package, self._config, self._refine = package, config, refine
        self._matcher = make_matcher(config.features)
        self._landmarks = LandmarkLocalizer(
            package.landmarks, config.coarse, self._matcher.min_similarity
        )
        self._network = network_of(package, config)
        self._refiner = Refiner(
            lambda camera, T: render_scene(package, camera, T, config.runtime.threads),
            self._matcher, config.features.keypoints, config.refine, config.verify,
        )  # fmt: skip

    def localize(
        self, image: Image, camera: Camera, prior: ArrayLike | None = None
    ) -> LocalizationResult:
        timer = StageTimer()
        image, camera = shrunk(image, camera, self._config)
        query = Query(image, camera, self._matcher, self._config.features.keypoints, timer)
        hypotheses = (
            self._landmarks.hypotheses(query.features, camera) if self._network is None
            else self._network.hypotheses(image, camera)
        )  # fmt: skip
        for hypothesis in hypotheses:
            refinement = self._refine(self._refiner, query, hypothesis.T_scene_cam)
            evidence = refinement.evidence
            if refinement.T_scene_cam is not None and judge(evidence, self._config.verify)[0].ok:
                return _answer(
                    self._package, refinement.T_scene_cam, evidence.inliers, timer, "landmarks"
                )
        return _answer(self._package, None, 0, timer, "landmarks")
