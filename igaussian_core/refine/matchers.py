"""Pixels of an image and of a render that show the same point: all matchers behind one call."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray

from igaussian_core.config import RefineConfig
from igaussian_core.errors import ConfigError, WeightsError
from igaussian_core.features import (
    Features,
    Matcher,
    SiftMatcher,
    XFeatMatcher,
    load_strictly,
)
from igaussian_core.query import Query
from igaussian_core.torch_cpu import has_native_bfloat16

Pixels = NDArray[np.float32]
Pairs = tuple[Pixels, Pixels]

_CELL = 8  # pixels of a coarse cell of XFeat and LoFTR
_FINE_CONFIDENCE = 0.25  # XFeat's own threshold of its fine matcher


class PairMatcher(Protocol):
    """Matches a frame with a render of the same size."""

    name: str

    def match(self, query: Query, render: NDArray[np.uint8]) -> Pairs:
        """Pixels [M, 2] of the frame and [M, 2] of the render, uint8 RGB [H, W, 3]."""
        ...


def make_pair_matcher(config: RefineConfig, keypoint_matcher: Matcher, count: int) -> PairMatcher:
    """The matcher of `refine.matcher`; `auto` takes the keypoints that the map was made with.

    Raises:
        WeightsError: a checkpoint that is missing or does not fit.
        ConfigError: LoFTR without a path of its checkpoint.
    """
    if config.matcher == "loftr":
        if not config.loftr_weights:
            raise ConfigError("refine.matcher=loftr needs refine.loftr_weights, a checkpoint file")
        return Loftr(config.loftr_weights)
    if config.matcher == "xfeat_semi_dense":
        return SemiDense(_xfeat(keypoint_matcher))
    if config.matcher == "xfeat":
        return Keypoints(_xfeat(keypoint_matcher), keypoint_matcher, count)
    if config.matcher == "sift" and keypoint_matcher.name != "sift":
        return Keypoints(SiftMatcher(), keypoint_matcher, count)
    return Keypoints(keypoint_matcher, keypoint_matcher, count)


class Keypoints:
    """Keypoints of both images and their matcher: XFeat + LighterGlue, or SIFT.

    Args:
        matcher: extracts and matches.
        of_query: the matcher whose features the frame already has.
        count: keypoints an image.
    """

    def __init__(self, matcher: Matcher, of_query: Matcher, count: int) -> None:
        self.name = matcher.name
        self._matcher, self._count = matcher, count
        self._shared = matcher.name == of_query.name

    def match(self, query: Query, render: NDArray[np.uint8]) -> Pairs:
        a, b = self._features(query, render)
        with query.timer("match"):
            pairs = self._matcher.match(a, b)
        return a.uv[pairs[:, 0]], b.uv[pairs[:, 1]]

    def _features(self, query: Query, render: NDArray[np.uint8]) -> tuple[Features, Features]:
        shared = query.features if self._shared else None
        with query.timer("extract"):
            a = shared or query.once(
                self.name, lambda: self._matcher.extract(query.image, self._count)
            )
            return a, self._matcher.extract(render, self._count)


class GuidedKeypoints(Keypoints):
    """Mutual nearest neighbours among keypoints that lie where a good prior says they should.

    A render at a prior shows a point where the image does but for the prior's error, so looking
    at neighbours within a radius replaces the network that compares all with all.
    """

    def __init__(self, matcher: Matcher, count: int, radius_px: float) -> None:
        super().__init__(matcher, matcher, count)
        self._radius_px = radius_px

    def match(self, query: Query, render: NDArray[np.uint8]) -> Pairs:
        a, b = self._features(query, render)
        with query.timer("match"):
            pairs = near_matches(a, b, self._radius_px)
        return a.uv[pairs[:, 0]], b.uv[pairs[:, 1]]


class SemiDense:
    """XFeat's cells of 8 x 8 pixels, mutual nearest neighbours, offsets by its fine matcher.

    The semi-dense mode of XFeat (Potje et al., CVPR 2024) at one scale: the render has the
    frame's scale already.
    """

    name = "xfeat_semi_dense"

    def __init__(self, xfeat: XFeatMatcher, cells: int = 4096) -> None:
        self._net, self._cells = xfeat.net, cells

    @torch.inference_mode()
    def match(self, query: Query, render: NDArray[np.uint8]) -> Pairs:
        with query.timer("extract"):
            uv_a, a = query.once(self.name, lambda: self._describe(query.image))
            uv_b, b = self._describe(render)
        with query.timer("match"):
            similarity = F.normalize(a, dim=1) @ F.normalize(b, dim=1).T
            best, back = similarity.argmax(1), similarity.argmax(0)
            index = torch.nonzero(back[best] == torch.arange(len(a)))[:, 0]
            best = best[index]
            logits = self._net.fine_matcher(torch.cat([a[index], b[best]], 1))
            probability = F.softmax(3 * logits, 1)  # 3: the temperature it was trained with
            sure = probability.max(1).values > _FINE_CONFIDENCE
            uv_image = uv_a[index] + probability @ _cell_offsets()
        return uv_image[sure].numpy(), uv_b[best][sure].numpy()

    def _describe(self, image: NDArray[np.uint8]) -> tuple[torch.Tensor, torch.Tensor]:
        """First pixels [N, 2] and raw descriptors [N, 64] of the most reliable cells."""
        height, width = image.shape[:2]
        gray = _gray(image)
        padded = F.pad(gray, (0, -width % 32, 0, -height % 32), mode="replicate")
        descriptors, _, reliability = self._net(padded.to(memory_format=torch.channels_last))
        rows, columns = -(-height // _CELL), -(-width // _CELL)  # without those of the padding
        score = reliability[0, 0, :rows, :columns].reshape(-1)
        index = score.topk(min(self._cells, len(score))).indices
        found = descriptors[0, :, :rows, :columns].flatten(1)[:, index].T
        uv = _CELL * torch.stack([index % columns, index // columns], 1).to(torch.float32)
        return uv, found  # their lengths matter to the fine matcher


class Loftr:
    """LoFTR (Sun et al., CVPR 2021), the paper's matcher, from a checkpoint file.

    Takes the published files `loftr_outdoor.ckpt`, `loftr_indoor.ckpt` and
    `loftr_indoor_ds_new.ckpt`; the last one is known by its name, for its positions are encoded
    in another way. Computes in bfloat16 where the CPU does.

    Raises:
        WeightsError: no file, not of tensors only, or of another network.
    """

    name = "loftr"

    def __init__(self, path: str | Path) -> None:
        import kornia.feature as KF
        from kornia.feature.loftr.loftr import default_cfg

        path = Path(path)
        state = _read_checkpoint(path)
        settings: dict[str, Any] = copy.deepcopy(default_cfg)
        settings["coarse"]["temp_bug_fix"] = path.stem.endswith("_new")
        self._net: Any = KF.LoFTR(pretrained=None, config=settings)
        load_strictly(self._net, state, str(path))
        self._type = torch.bfloat16 if has_native_bfloat16() else torch.float32
        self._net.eval().to(self._type)

    @torch.inference_mode()
    def match(self, query: Query, render: NDArray[np.uint8]) -> Pairs:
        with query.timer("extract"):
            a = query.once(self.name, lambda: self._net.extract_features(self._input(query.image)))
            b = self._net.extract_features(self._input(render))
        with query.timer("match"):
            found = self._net({"features0": a, "features1": b})
        # LoFTR counts pixels from the corner, the first one's centre at 0.5
        uv_a, uv_b = (found[f"keypoints{i}"].float().numpy() - np.float32(0.5) for i in (0, 1))
        inside = _inside(uv_a, query.image) & _inside(uv_b, render)
        return uv_a[inside], uv_b[inside]

    def _input(self, image: NDArray[np.uint8]) -> torch.Tensor:
        """Grey [1, 1, H, W] in [0, 1], padded to cells: pixels stay where they are."""
        height, width = image.shape[:2]
        padded = F.pad(_gray(image), (0, -width % _CELL, 0, -height % _CELL), mode="replicate")
        return (padded / 255).to(self._type)


def near_matches(a: Features, b: Features, radius_px: float) -> NDArray[np.int64]:
    """Mutual nearest neighbours [M, 2] by descriptors, among pixels within a radius."""
    if len(a) == 0 or len(b) == 0:
        return np.zeros((0, 2), np.int64)
    similarity = torch.from_numpy(a.descriptors) @ torch.from_numpy(b.descriptors).T
    far = torch.cdist(torch.from_numpy(a.uv), torch.from_numpy(b.uv)) > radius_px
    similarity[far] = -1
    value, best = similarity.max(1)
    mutual = similarity.argmax(0)[best] == torch.arange(len(a))
    index = torch.nonzero(mutual & (value > 0))[:, 0]
    return np.asarray(torch.stack([index, best[index]], 1).numpy(), np.int64)


def _xfeat(matcher: Matcher) -> XFeatMatcher:
    return matcher if isinstance(matcher, XFeatMatcher) else XFeatMatcher()


def _gray(image: NDArray[np.uint8]) -> torch.Tensor:
    return torch.from_numpy(image.astype(np.float32).mean(axis=2))[None, None]


def _cell_offsets() -> torch.Tensor:
    """Offsets [64, 2] in pixels that the outputs of XFeat's fine matcher stand for."""
    side = torch.arange(_CELL, dtype=torch.float32) - _CELL // 2
    y, x = torch.meshgrid(side, side, indexing="ij")
    return torch.stack([x.reshape(-1), y.reshape(-1)], 1)


def _inside(uv: Pixels, image: NDArray[np.uint8]) -> NDArray[np.bool_]:
    height, width = image.shape[:2]
    return np.asarray(((uv >= -0.5) & (uv <= [width - 0.5, height - 0.5])).all(1))


def _read_checkpoint(path: Path) -> dict[str, torch.Tensor]:
    """The tensors of a LoFTR checkpoint, under the names of the network's layers."""
    if not path.is_file():
        raise WeightsError(f"{path}: no such file; docs/matchers.md says where LoFTR's are")
    try:
        data: Any = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        cause = str(error).splitlines()[0]
        raise WeightsError(f"{path}: not a checkpoint of tensors: {cause}") from error
    state = data.get("state_dict", data) if isinstance(data, dict) else None
    if not isinstance(state, dict) or not all(torch.is_tensor(v) for v in state.values()):
        raise WeightsError(f"{path}: no 'state_dict' of tensors in it")
    return {name.removeprefix("matcher."): value for name, value in state.items()}
