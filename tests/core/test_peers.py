"""The methods that we compare with: they work, and they cannot be given the truth."""

from __future__ import annotations

import inspect
import json
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import room

from igaussian_core.config import Config
from igaussian_core.evaluate.runner import Estimator
from igaussian_core.gaussian_map import GaussianMap
from igaussian_core.geometry import compose, pose_error, rotation_from_vector
from igaussian_core.map_package import MapPackage, open_package
from igaussian_core.result import Status

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))

import make_docs  # noqa: E402
import peer_methods as peers  # noqa: E402
import peers as peers_command  # noqa: E402
import tables  # noqa: E402

METHODS = (peers.SfmSift, peers.EssentialMatrix, peers.GradientDescent, peers.CoarseOnly,
           peers.Staged)  # fmt: skip
CONFIG = Config()
POSES = room.query_poses(3, seed=12)


@pytest.mark.parametrize("method", METHODS, ids=lambda m: m.__name__)
def test_no_peer_can_be_given_the_truth(method: type) -> None:
    assert list(inspect.signature(method.localize).parameters) == [  # type: ignore[attr-defined]
        "self", "image", "camera", "prior",
    ]  # fmt: skip
    for parameter in inspect.signature(method).parameters.values():
        assert parameter.kind is parameter.POSITIONAL_OR_KEYWORD
        for word in ("truth", "true", "gt", "ground", "expected", "target", "queries"):
            assert word not in parameter.name


@pytest.fixture(scope="module")
def package(room_igmap: Path) -> MapPackage:
    return open_package(room_igmap)


@pytest.fixture(scope="module")
def references(package: MapPackage) -> list[peers.Reference]:
    count = package.landmarks.view_count
    return [peers.reference_of_map(package, view, CONFIG) for view in range(count)]


def errors(estimator: Estimator, gmap: GaussianMap) -> np.ndarray:
    """Degrees and metres [N, 2] at the room's queries; inf where there is no pose."""
    found = []
    for seed, T in enumerate(POSES):
        result = estimator.localize(room.photo(gmap, T, seed=seed), room.CAMERA)
        assert result.timings_ms["total"] > 0
        found.append((np.inf, np.inf) if result.T_map_cam is None
                     else pose_error(result.T_map_cam, T))  # fmt: skip
    return np.array(found)


@pytest.mark.parametrize(
    ("make", "max_deg", "max_m"),
    [
        (lambda p, r: peers.CoarseOnly(p, CONFIG), 2.0, 0.1),
        (lambda p, r: peers.Staged(p, CONFIG, lambda f, q, T: f.match(q, T)), 0.5, 0.03),
        (lambda p, r: peers.Staged(p, CONFIG, lambda f, q, T: f.align(q, T)), 0.3, 0.02),
        (lambda p, r: peers.EssentialMatrix(p, r, CONFIG), 5.0, 0.4),
        (lambda p, r: peers.GradientDescent(p, CONFIG, "coarse", 20), 2.0, 0.1),
    ],
    ids=["landmarks", "matching", "alignment", "essential", "descent"],
)
def test_peers_work(
    make: Callable[..., Estimator], max_deg: float, max_m: float, package: MapPackage,
    references: list[peers.Reference], room_map: GaussianMap,
) -> None:  # fmt: skip
    middle = np.median(errors(make(package, references), room_map), axis=0)
    assert middle[0] < max_deg and middle[1] < max_m


def test_structure_from_motion_works(
    package: MapPackage, references: list[peers.Reference], room_map: GaussianMap
) -> None:
    pytest.importorskip("pycolmap", reason="the extra `bench` is not installed")
    middle = np.median(errors(peers.SfmSift(package, references, CONFIG), room_map), axis=0)
    assert middle[0] < 2 and middle[1] < 0.1


def test_descent_goes_downhill(package: MapPackage, room_map: GaussianMap) -> None:
    """From 3 degrees and 3 cm beside the truth it comes nearer; without the photo's noise."""
    T = POSES[0]
    prior = compose(rotation_from_vector([0, 0, np.radians(3)]) @ T[:3, :3], T[:3, 3] + 0.017)
    image = room.photo(room_map, T)
    result = peers.GradientDescent(package, CONFIG, "prior", 60).localize(
        image, room.CAMERA, prior
    )
    assert result.T_map_cam is not None
    assert pose_error(result.T_map_cam, T)[0] < 0.5 * pose_error(prior, T)[0]


def test_triangulated_depth() -> None:
    rng = np.random.default_rng(0)
    T_b_a = compose(rotation_from_vector([0.1, -0.2, 0.05]), [1.0, 0.1, 0.0])
    points_a = rng.uniform([-1, -1, 3], [1, 1, 6], (20, 3))
    points_b = points_a @ T_b_a[:3, :3].T + T_b_a[:3, 3]
    depth = peers._triangulated_depth(
        T_b_a, points_a / points_a[:, 2:], points_b / points_b[:, 2:]
    )
    np.testing.assert_allclose(depth, points_a[:, 2], rtol=1e-6)
    T_b_a[:3, 3] *= -1  # now the rays meet behind both cameras
    behind = peers._triangulated_depth(
        T_b_a, points_a / points_a[:, 2:], points_b / points_b[:, 2:]
    )
    assert (behind <= 0).all()


def test_nothing_in_sight_is_no_pose(
    package: MapPackage, references: list[peers.Reference]
) -> None:
    gray = np.full((240, 320, 3), 127, np.uint8)
    for estimator in (peers.CoarseOnly(package, CONFIG),
                      peers.EssentialMatrix(package, references, CONFIG)):  # fmt: skip
        result = estimator.localize(gray, room.CAMERA)
        assert result.T_map_cam is None and result.status is Status.NO_HYPOTHESIS


# --- the generated page ---


def test_the_page_of_benchmarks_is_current() -> None:
    """docs/benchmarks.md is what make_docs.py makes of benchmarks/results."""
    assert make_docs.PAGE.read_text() == make_docs.page(make_docs.RESULTS)
    assert {p.stem for p in make_docs.RESULTS.glob("*.json")} <= set(make_docs.SECTIONS)


def test_measured_rows_take_the_place_of_their_own_alone() -> None:
    before = [{"case": "a", "method": m, "summary": m} for m in ("ours", "other", "trained")]
    now = [
        {"case": "a", "method": "ours", "summary": "anew"},
        {"case": "b", "method": "ours", "summary": "new"},
    ]
    merged = peers_command._merged(before, now)
    assert [row["summary"] for row in merged] == ["anew", "other", "trained", "new"]


def test_rows_of_peers() -> None:
    figures = {"success": 1.0, "median_ms": 12.3, "queries": 3, "mean_deg": 0.5}
    rows = [{"case": "lego", "method": "ours", "summary": figures, "groups": {"20-40": figures}}]
    assert "| lego | ours | 3 | 100.0 % | 12 |" in tables.peers_markdown("rendered", rows)
    assert "| lego | ours | 3 | 100.0 % | – | 0.500 |" in tables.peers_markdown("photos", rows)


def test_a_verdict_counts_by_kind_of_image() -> None:
    def row(accepted: int, right: int, usable: bool) -> dict[str, object]:
        return {"images": 9, "accepted": accepted, "right": right, "usable": usable,
                "wrong_accepted": accepted - right, "wrong_inliers": 7,
                "wrong_confidence": 0.25}  # fmt: skip

    text = tables.verdict({"images": {"as taken": row(9, 8, True), "black": row(2, 0, False)}})
    assert "| black | 9 | 2 | 0 | 2 | 7 | 0.25 |" in text
    assert text.endswith("Wrong but accepted: 3 of 18. Right: 8 of 9 usable photos.")


def test_a_covariance_too_few_poses_could_calibrate() -> None:
    figures = {"mean_nees": 4.0, "median_nees": 3.0, "inside_95": 1.0}
    few = {"poses": 7, "calibrated_on": 6, **figures}
    many = {"poses": 9, "calibrated_on": 50, **figures, "factor": 0.5, "after": figures}
    text = tables.covariance(
        {"sets": {"fox": {"accepted": 7, **figures}}, "calibrated": {"fox": few, "lego": many}}
    )
    assert "| fox | 7 | 4.0 | 3.0 | 100.0 % |" in text
    assert "| fox | 7 | 4.0 | 100 % | 6 | too few | – | – |" in text
    assert "| lego | 9 | 4.0 | 100 % | 50 | 0.50 | 4.0 | 100 % |" in text


def test_kept_figures_hold_no_single_queries(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(make_docs, "RESULTS", tmp_path / "results")
    out = tmp_path / "out.json"
    out.write_text(json.dumps({"summary": {}, "queries": [1], "config": {}}))
    make_docs.keep(out, "demo_rendered")
    kept = json.loads((tmp_path / "results" / "demo_rendered.json").read_text())
    assert kept == {"summary": {}}
    with pytest.raises(SystemExit, match="none of"):
        make_docs.keep(out, "other")
