"""Attention over thousands of source views: kernel regression among views of known pose.

The paper's coarse pose is a weighted mean of what its source views say. With few of them each
has to be corrected by a network; with thousands, which the map renders in seconds, their own
poses are enough. Keys K are the backbone's features of the source views, the query k those of
the image, and the weights those of kernel ridge regression (Saunders et al. 1998), which is the
mean of a Gaussian process:

    w = k(query, keys) (K + lambda I)^-1        T_coarse = mean + sum of w_i (T_i - mean)

with the Matern kernel of order 3/2. The inverse does not depend on the image, so that it is
applied to the poses once.

The image is asked about seven times, as the camera turned a little about each of its axes would
see it: turned back and averaged, the answers are a quarter more exact than one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from igaussian_core.camera import Camera
from igaussian_core.coarse.canonical import to_tensor, turned
from igaussian_core.errors import MapError
from igaussian_core.geometry import mean_rotation, nearest_rotation, rotation_from_vector

Array = NDArray[np.float64]

GRID = 2  # features are averaged over so many by so many parts of the image
_RIDGE = 0.0005  # of the kernel's value at zero distance
_WIDTH = 1.0  # of the kernel, in median distances of keys
_LARGEST_RIDGE = 1.0
_SAMPLE = 512  # keys whose distances tell the median
_TURNS_DEG = ((0, 0, 0), (0, 0, 6), (0, 0, -6), (3, 0, 0), (-3, 0, 0), (0, 3, 0), (0, -3, 0))
_OUTLYING = 3.0  # median distances from the middlemost answer, beyond which one is left out


class ViewMemory(NamedTuple):
    """What is kept of N views of one map.

    Attributes:
        centre: float32 [D] mean of the raw features.
        basis: float32 [D, E] of the space that keys live in.
        keys: float16 [N, E].
        width: float32 [1] of the kernel.
        poses: float32 [N, 12]: rotation of T_scene_cam by rows, position, normalised units.
        mean: float32 [12] of the poses.
        coefficients: float32 [N, 12]: (K + lambda I)^-1 (poses - mean).
    """

    centre: Tensor
    basis: Tensor
    keys: Tensor
    width: Tensor
    poses: Tensor
    mean: Tensor
    coefficients: Tensor

    def regressed(self, similarity: Tensor) -> tuple[Array, Array]:
        """Rotations [B, 3, 3] and positions [B, 3], normalised units, of kernel values [B, N]."""
        return _as_poses(similarity @ self.coefficients + self.mean)

    def pose_of(self, index: int) -> tuple[Array, Array]:
        """Rotation [3, 3] and position [3] of one of the views."""
        rotations, positions = _as_poses(self.poses[index : index + 1])
        return rotations[0], positions[0]


class Recalled(NamedTuple):
    """What a memory says of an image.

    Attributes:
        rotation: [3, 3] of T_scene_cam.
        position: [3], normalised units.
        similarity: [N] of the image itself with each view.
    """

    rotation: Array
    position: Array
    similarity: Tensor


class Recall:
    """Asks a memory for the poses of images.

    Args:
        memory: of one map.
        backbone: whose features its keys are of.
        camera: the canonical camera of images.
    """

    def __init__(self, memory: ViewMemory, backbone: nn.Module, camera: Camera) -> None:
        self.memory, self._backbone, self._camera = memory, backbone, camera
        # widened and squared once: cdist would copy all keys for every image
        self._keys = memory.keys.float()
        self._squared = self._keys.square().sum(1)
        self._turns = np.array([rotation_from_vector(np.radians(a)) for a in _TURNS_DEG])

    @torch.inference_mode()
    def __call__(self, image: NDArray[np.uint8]) -> Recalled:
        """The pose of an image: uint8 RGB of the canonical camera."""
        looks = [turned(image, self._camera, turn) for turn in self._turns[1:]]
        similarity = self.similarity(self._backbone(to_tensor(np.stack([image, *looks]))))
        rotations, positions = self.memory.regressed(similarity)
        rotations = rotations @ self._turns.transpose(0, 2, 1)
        kept = _agreeing(rotations, positions)
        return Recalled(mean_rotation(rotations[kept]), positions[kept].mean(0), similarity[0])

    def similarity(self, features: Tensor) -> Tensor:
        """Kernel values [B, N] in [0, 1] of the backbone's features [B, C, h, w]."""
        memory = self.memory
        queries = (raw_keys(features) - memory.centre) @ memory.basis
        squared = queries.square().sum(1, keepdim=True) + self._squared
        squared.addmm_(queries, self._keys.T, alpha=-2)
        return matern(squared.clamp_(min=0).sqrt_(), memory.width)


def _agreeing(rotations: Array, positions: Array) -> NDArray[np.bool_]:
    """Which answers are near the one that is nearest to all."""
    numbers = np.concatenate([rotations.reshape(-1, 9), positions], 1)
    distances = np.linalg.norm(numbers[:, None] - numbers[None], axis=2)
    from_middle = distances[np.median(distances, axis=1).argmin()]
    return from_middle <= _OUTLYING * max(float(np.median(from_middle)), 1e-9)


def raw_keys(features: Tensor) -> Tensor:
    """[B, C * 4], the means of the backbone's features [B, C, h, w] over an image's quarters."""
    return F.adaptive_avg_pool2d(features.float(), GRID).flatten(1)


@torch.no_grad()
def fit_memory(
    raw: Tensor, rotation: Tensor, position: Tensor, dimensions: int = 256
) -> ViewMemory:
    """A memory of N views.

    Takes 4 N^2 bytes three times over, and seconds for ten thousand views.

    Args:
        raw: [N, D] of `raw_keys`.
        rotation: [N, 3, 3] of T_scene_cam.
        position: [N, 3], normalised units.
        dimensions: of the keys, the principal ones of the raw ones.

    Raises:
        MapError: features that are not finite.
    """
    if not torch.isfinite(raw).all():
        raise MapError("pose network: features of the map's views are not finite")
    centre = raw.mean(0)
    # every feature counts by its own variance, so that those that tell nothing stay silent
    centred = (raw - centre).double()
    _, directions = torch.linalg.eigh(centred.T @ centred)
    basis = directions[:, -dimensions:].flip(1).float().contiguous()
    keys = ((raw - centre) @ basis).half()
    poses = torch.cat([rotation.flatten(1), position], 1)
    _, width, mean, coefficients = fit_regression(keys.float(), poses, _RIDGE)
    return ViewMemory(centre, basis, keys, width.reshape(1), poses, mean, coefficients)


class Regression(NamedTuple):
    """Kernel ridge regression of values [V] by keys [E].

    Attributes:
        keys: [N, E] at which values are known.
        width: of the kernel.
        mean: [V] of the values.
        coefficients: [N, V].
    """

    keys: Tensor
    width: Tensor
    mean: Tensor
    coefficients: Tensor

    def predict(self, keys: Tensor) -> Tensor:
        """Values [B, V] at other keys [B, E]."""
        return matern(torch.cdist(keys, self.keys), self.width) @ self.coefficients + self.mean


def fit_regression(keys: Tensor, values: Tensor, ridge: float) -> Regression:
    """Of values [N, V] at keys [N, E].

    Raises:
        MapError: keys that cannot be told apart, or are not finite.
    """
    width = _WIDTH * torch.cdist(keys[:_SAMPLE], keys).median().clamp(min=1e-6)
    mean = values.mean(0)
    while ridge <= _LARGEST_RIDGE:
        gram = matern(torch.cdist(keys, keys), width)
        gram.diagonal().add_(ridge)
        factor, failed = torch.linalg.cholesky_ex(gram)
        del gram
        if not failed:
            return Regression(keys, width, mean, torch.cholesky_solve(values - mean, factor))
        ridge *= 10  # many views alike
    raise MapError("pose network: the map's views cannot be told apart")


def matern(distance: Tensor, width: Tensor) -> Tensor:
    """The kernel of order 3/2; overwrites the distances where no gradient flows through them."""
    if distance.requires_grad:
        scaled = distance * (3**0.5 / width)
        return torch.exp(-scaled) * (1 + scaled)
    scaled = distance.mul_(3**0.5 / width)
    return torch.exp(-scaled).mul_(scaled.add_(1))


def _as_poses(numbers: Tensor) -> tuple[Array, Array]:
    values = numbers.double().numpy()
    rotations = np.array([nearest_rotation(m) for m in values[:, :9].reshape(-1, 3, 3)])
    return rotations, values[:, 9:]
