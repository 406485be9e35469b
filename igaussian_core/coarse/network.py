"""Hypotheses from the pose network: no prior, no iterations; one render back where asked for."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.torch import save_file
from torch import Tensor

from igaussian_core.camera import Camera
from igaussian_core.coarse.attention import NetworkConfig, PoseNetwork, SourceViews
from igaussian_core.coarse.canonical import cell_rays, resampled, to_tensor
from igaussian_core.coarse.look_back import Render, looked_back
from igaussian_core.coarse.memory import GRID, Recall, ViewMemory
from igaussian_core.coarse.pose_scale import PoseScale
from igaussian_core.errors import MapError
from igaussian_core.geometry import compose, mean_rotation, pose_error
from igaussian_core.hypothesis import Hypothesis
from igaussian_core.map_package import NetworkData, read_tensors

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

FORMAT = "igaussian-pose-network-1"
_WEIGHT = "network."
_VIEWS = "views."
_MEMORY = "memory."
# hypotheses nearer than that to one before them are left out
_SAME_DEG, _SAME_LENGTHS = 5.0, 0.1


@dataclasses.dataclass(frozen=True)
class MapNetwork:
    """A pose network with what it needs of one map.

    Attributes:
        network: in evaluation mode.
        views: of the map, normalised units.
        camera: the canonical camera of images and source views.
        scale: from normalised to scene units.
        report: what training says of it: steps, errors on views that it was not trained on.
        memory: views whose poses predict, by the backbone's features; None: the network's
            candidates and weights do.
    """

    network: PoseNetwork
    views: SourceViews
    camera: Camera
    scale: PoseScale
    report: dict[str, Any]
    memory: ViewMemory | None = None

    def data(self) -> NetworkData:
        """As a compiled map stores it."""
        tensors = {k: v.numpy() for k, v in _weights(self.network).items()}
        for name, value in self.views._asdict().items():
            value = value.half() if name == "features" else value
            tensors[_VIEWS + name] = np.ascontiguousarray(value.numpy())
        for name, value in self.memory._asdict().items() if self.memory else ():
            tensors[_MEMORY + name] = np.ascontiguousarray(value.numpy())
        meta = {
            "config": dataclasses.asdict(self.network.config),
            "camera": [getattr(self.camera, f) for f in _CAMERA],
            "scale": dataclasses.asdict(self.scale),
            "report": self.report,
        }
        return NetworkData(tensors, {"format": FORMAT, "network": json.dumps(meta)})

    @staticmethod
    def from_data(data: NetworkData, origin: str) -> MapNetwork:
        """Raises MapError, naming `origin`, where anything is missing, left over or misshapen."""
        config, meta = _config_of(data.meta, origin)
        network = PoseNetwork(config)
        _load(network, data.tensors, origin)
        try:
            views = SourceViews(
                **{f: torch.from_numpy(data.tensors[_VIEWS + f]) for f in SourceViews._fields}
            )
            memory = _memory_of(data.tensors, GRID**2 * network.backbone.channels)
            camera = Camera(**dict(zip(_CAMERA, meta["camera"], strict=True)))
            scale = PoseScale(tuple(meta["scale"]["centre"]), float(meta["scale"]["length"]))
        except (KeyError, TypeError, ValueError) as error:
            raise MapError(f"{origin}: damaged pose network: {error}") from error
        views = views._replace(features=views.features.float())
        return MapNetwork(network.eval(), views, camera, scale, meta.get("report", {}), memory)


class NetworkLocalizer:
    """Coarse poses of images in one map.

    Args:
        trained: the map's network.
        hypotheses: most that are handed on.
        head: "memory", where there is one, or "attention".
        render: of the map; None: no answer is corrected.
        renders: by how many the first hypothesis is corrected.
    """

    def __init__(
        self, trained: MapNetwork, hypotheses: int, head: str = "memory",
        render: Render | None = None, renders: int = 0,
    ) -> None:  # fmt: skip
        self._trained = trained
        self._count = hypotheses
        self._render, self._renders = render, renders if render else 0
        self._recall: Recall | None = None
        if head == "memory" and trained.memory is not None:
            self._recall = Recall(trained.memory, trained.network.backbone, trained.camera)
        self._rays = cell_rays(trained.camera)[None]

    def hypotheses(self, image: Image, camera: Camera) -> Iterator[Hypothesis]:
        """The best guess first, then others that say something else.

        Of the memory the regressed pose, then those of single views by falling similarity; of
        the attention the weighted mean, then candidates of single source views by falling
        weight. Those that follow are the others that the image may show as well.

        Args:
            image: uint8 RGB [H, W, 3].
            camera: its pinhole camera.
        """
        found: list[Array] = []
        small = resampled(image, camera, self._trained.camera)
        answers = self._answers(small)
        first, score = next(answers)
        found.append(self._corrected(small, first) if self._renders else first)
        others = (T_scene_cam for T_scene_cam, _ in answers)
        yield Hypothesis(found[0], score, "network", others=others)
        for T_scene_cam, score in answers:
            if len(found) >= self._count:
                return
            if all(self._differs(T_scene_cam, other) for other in found):
                found.append(T_scene_cam)
                yield Hypothesis(T_scene_cam, score, "network", others=others)

    def _corrected(self, small: Image, T_scene_cam: Array) -> Array:
        assert self._render is not None
        return looked_back(
            small, self._trained.camera, T_scene_cam,
            lambda seen: next(self._answers(seen))[0],
            self._render, self._renders, self._trained.scale.length,
        )  # fmt: skip

    def _answers(self, small: Image) -> Iterator[tuple[Array, float]]:
        """Poses T_scene_cam and scores of an image of the canonical camera."""
        found = self._attended(small) if self._recall is None else self._remembered(small)
        for rotation, position, score in found:
            yield compose(rotation, self._trained.scale.scene(position)), score

    def _remembered(self, image: Image) -> Iterator[tuple[Array, Array, float]]:
        assert self._recall is not None
        recalled = self._recall(image)
        yield recalled.rotation, recalled.position, 1.0
        score, order = recalled.similarity.sort(descending=True, stable=True)
        for value, index in zip(score.tolist(), order.tolist(), strict=True):
            yield *self._recall.memory.pose_of(index), value

    def _attended(self, image: Image) -> Iterator[tuple[Array, Array, float]]:
        with torch.inference_mode():
            said = self._trained.network(to_tensor(image[None]), self._rays, self._trained.views)
        candidates = said.candidate_rotations, said.candidate_positions
        rotations, positions = (part[0].double().numpy() for part in candidates)
        weights = said.log_weights[0].double().exp().numpy()
        yield mean_rotation(rotations, weights), weights @ positions, 1.0
        for index in np.argsort(-weights, kind="stable"):
            yield rotations[index], positions[index], float(weights[index])

    def _differs(self, T_a: Array, T_b: Array) -> bool:
        angle, distance = pose_error(T_a, T_b)
        return angle > _SAME_DEG or distance > _SAME_LENGTHS * self._trained.scale.length


_CAMERA = ("width", "height", "fx", "fy", "cx", "cy")


def _memory_of(tensors: dict[str, NDArray[Any]], features: int) -> ViewMemory | None:
    """Raises KeyError where a part is missing, ValueError where one does not fit."""
    names = [_MEMORY + name for name in ViewMemory._fields]
    if not any(name in tensors for name in names):
        return None
    memory = ViewMemory(*(torch.from_numpy(tensors[name]) for name in names))
    views, dimensions = memory.keys.shape
    wanted = ((features,), (features, dimensions), (views, dimensions), (1,), (views, 12), (12,),
              (views, 12))  # fmt: skip
    for name, part, shape in zip(names, memory, wanted, strict=True):
        if part.shape != shape or not torch.isfinite(part).all():
            raise ValueError(f"{name}: not finite numbers of shape {shape}")
    return memory


def _weights(network: PoseNetwork) -> dict[str, Tensor]:
    """As they are stored: in half precision, which is plenty for networks of this kind."""
    return {
        _WEIGHT + k: (v.half() if v.is_floating_point() else v).contiguous()
        for k, v in network.state_dict().items()
    }


def save_checkpoint(network: PoseNetwork, path: Path, report: dict[str, Any]) -> None:
    """Weights alone in half precision, for every map to start from.

    Raises:
        MapError: `path` cannot be written.
    """
    meta = {"config": dataclasses.asdict(network.config), "report": report}
    try:
        save_file(_weights(network), str(path), {"format": FORMAT, "network": json.dumps(meta)})
    except (OSError, SafetensorError) as error:
        raise MapError(f"{path}: cannot be written: {error}") from error


def load_checkpoint(path: Path) -> PoseNetwork:
    """The network of a checkpoint, in training mode.

    Raises:
        MapError: missing, unreadable, or parameters missing, left over, of other shapes.
    """
    try:
        data = read_tensors(path)
    except (OSError, SafetensorError) as error:
        raise MapError(f"{path}: unreadable weights: {error}") from error
    config, _ = _config_of(data.meta, str(path))
    network = PoseNetwork(config)
    _load(network, data.tensors, str(path))
    return network


def shipped_checkpoint() -> Path:
    """The joint checkpoint that comes with the project."""
    return Path(__file__).resolve().parents[1] / "weights" / "pose_network.safetensors"


def _config_of(meta: dict[str, str], origin: str) -> tuple[NetworkConfig, dict[str, Any]]:
    if meta.get("format") != FORMAT:
        raise MapError(f"{origin}: no pose network of this release (format {meta.get('format')})")
    try:
        parsed = json.loads(meta["network"])
        return NetworkConfig(**parsed["config"]), parsed
    except (KeyError, TypeError, ValueError) as error:
        raise MapError(f"{origin}: damaged pose network: {error}") from error


def _load(network: PoseNetwork, tensors: dict[str, NDArray[Any]], origin: str) -> None:
    state = {
        name.removeprefix(_WEIGHT): torch.from_numpy(np.asarray(value)).to(
            torch.float32 if value.dtype.kind == "f" else torch.int64
        )
        for name, value in tensors.items()
        if name.startswith(_WEIGHT)
    }
    try:
        network.load_state_dict(state, strict=True)
    except RuntimeError as error:
        cause = "; ".join(line.strip() for line in str(error).splitlines()[1:])
        raise MapError(f"{origin}: weights do not fit the network: {cause[:300]}") from error
