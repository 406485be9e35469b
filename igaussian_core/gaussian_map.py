"""Gaussian maps: the arrays, their validation, and map files in and out.

Values are kept activated: linear scales, opacities in [0, 1], unit quaternions wxyz.
"""

from __future__ import annotations

import dataclasses
import hashlib
import logging
import os
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from igaussian_core.camera import Camera
from igaussian_core.errors import MapError
from igaussian_core.formats import RawGaussians, ply, read_gaussians, spz
from igaussian_core.render import Rasterizer, Render

log = logging.getLogger(__name__)
Array = NDArray[np.float32]

_MAX_BAD_SHARE = 0.5


@dataclass
class GaussianMap:
    """N anisotropic 3D Gaussians (Kerbl et al., 2023) in the scene's own frame and units.

    Attributes:
        means: [N, 3] float32.
        quats_wxyz: [N, 4] float32, unit length.
        scales: [N, 3] float32, standard deviations along the Gaussian's own axes.
        opacities: [N] float32 in [0, 1].
        sh: [N, K, 3] float32 spherical harmonics of the colour, K in 1, 4, 9, 16.
        antialiased: trained with the low-pass filter's opacity compensation (Mip-Splatting).
        dropped: Gaussians left out on loading, since they were not finite or had no rotation.
        file_format: what kind of file the map was read from, "" where it was made in memory.
        vertical_axis: "x", "y" or "z" where the file named the axis that points up, else "".
    """

    means: Array
    quats_wxyz: Array
    scales: Array
    opacities: Array
    sh: Array
    antialiased: bool = False
    dropped: int = 0
    file_format: str = ""
    vertical_axis: str = ""
    _rasterizer: Rasterizer | None = field(default=None, repr=False, compare=False)

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        return int(np.sqrt(self.sh.shape[1])) - 1

    def subset(self, index: NDArray[np.bool_] | NDArray[np.int64]) -> GaussianMap:
        """The Gaussians of a mask [N] or of indices, in a map of their own."""
        return dataclasses.replace(
            self, means=self.means[index], quats_wxyz=self.quats_wxyz[index],
            scales=self.scales[index], opacities=self.opacities[index], sh=self.sh[index],
            _rasterizer=None,
        )  # fmt: skip

    def for_small_images(self) -> GaussianMap:
        """The same Gaussians with the low-pass filter's opacity compensation: in images much
        smaller than those that a map was trained with, they would swell without it."""
        return dataclasses.replace(self, antialiased=True, _rasterizer=None)

    def rasterizer(self) -> Rasterizer:
        """The renderer of this map, packed on first use; not for two threads at once."""
        if self._rasterizer is None:
            self._rasterizer = Rasterizer(
                self.means, self.quats_wxyz, self.scales, self.opacities, self.sh, self.antialiased
            )
        return self._rasterizer

    def render(
        self,
        camera: Camera,
        T_cam_scene: ArrayLike,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        threads: int | None = None,
    ) -> tuple[Array, Array, Array]:
        """RGB [H, W, 3], expected depth [H, W] in scene units, and alpha [H, W], float32.

        Raises:
            CameraError: the camera has distortion; render with `camera.undistorted()`.
        """
        result: Render = self.rasterizer().render(
            camera, np.asarray(T_cam_scene, np.float64), background=background, threads=threads
        )
        assert result.rgb is not None and result.depth is not None and result.alpha is not None
        return result.rgb, result.depth, result.alpha

    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Corners of the box that holds the middle 98 % of the visible Gaussians on each axis.

        Raises:
            MapError: the map is empty.
        """
        means = self.means[self.opacities > 0.1] if (self.opacities > 0.1).any() else self.means
        if len(means) == 0:
            raise MapError("the map holds no Gaussian: it has no bounds")
        low, high = np.percentile(means, [1, 99], axis=0)
        return low.astype(np.float64), high.astype(np.float64)


def load_map(path: str | os.PathLike[str]) -> GaussianMap:
    """Read a Gaussian map from a file of any format in `igaussian_core.formats`.

    The content decides what a file is, its name only where the content does not tell. The map
    is in the frame of the INRIA .ply that the file came from.

    Raises:
        MapError: missing, truncated, no Gaussian map, or mostly not finite.
    """
    return _validated(Path(path), read_gaussians(Path(path)))


def save_ply(gmap: GaussianMap, path: str | os.PathLike[str]) -> None:
    """Write INRIA's binary little-endian .ply (float32, no normals)."""
    ply.write(_as_raw(gmap), Path(path))


def save_map(gmap: GaussianMap, path: str | os.PathLike[str]) -> None:
    """Write .ply or .spz, as the name ends; docs/map-formats.md has what .spz loses.

    Raises:
        MapError: another suffix, or a place that cannot be written.
    """
    writers = {".ply": ply.write, ".spz": spz.write}
    writer = writers.get(Path(path).suffix.lower())
    if writer is None:
        raise MapError(f"{path}: cannot write this format; supported: {', '.join(writers)}")
    try:
        writer(_as_raw(gmap), Path(path))
    except OSError as error:
        raise MapError(f"{path}: cannot be written: {error.strerror or error}") from error


def file_sha256(path: str | os.PathLike[str]) -> str:
    """Hexadecimal SHA-256 of a file's bytes; of a .sog folder, of its meta.json's bytes."""
    if os.path.isdir(path):
        path = Path(path) / "meta.json"
    with open(path, "rb") as stream:
        return _digest(iter(lambda: stream.read(1 << 20), b""))


def _digest(chunks: Iterable[bytes]) -> str:
    digest = hashlib.sha256()
    for chunk in chunks:
        digest.update(chunk)
    return digest.hexdigest()


def _as_raw(gmap: GaussianMap) -> RawGaussians:
    return RawGaussians(
        gmap.means, gmap.quats_wxyz, gmap.scales, gmap.opacities, gmap.sh, gmap.antialiased,
        vertical_axis=gmap.vertical_axis,
    )  # fmt: skip


def _validated(file: Path, raw: RawGaussians) -> GaussianMap:
    """The map without its unusable Gaussians, quaternions of unit length."""
    norms = np.linalg.norm(raw.quats_wxyz.astype(np.float64), axis=1)
    good = np.isfinite(norms) & (norms > 1e-9) & np.isfinite(raw.opacities)
    for part in (raw.means, raw.scales, raw.sh):
        good &= np.isfinite(part).all(axis=tuple(range(1, part.ndim)))
    bad = int(len(good) - good.sum())
    if bad > _MAX_BAD_SHARE * len(good):
        raise MapError(
            f"{file}: {bad} of {len(good)} Gaussians are not finite or have no rotation: "
            "the file is damaged"
        )
    with np.errstate(invalid="ignore", divide="ignore"):
        quats = (raw.quats_wxyz / norms[:, None]).astype(np.float32)
    gmap = GaussianMap(
        raw.means, quats, raw.scales, raw.opacities, raw.sh, raw.antialiased, bad,
        raw.file_format, raw.vertical_axis,
    )  # fmt: skip
    if bad == 0:
        return gmap
    log.warning("%s: left out %d of %d Gaussians (not finite or no rotation)",
                file, bad, len(good))  # fmt: skip
    return gmap.subset(good)
