"""Gaussian maps: the arrays, their validation, and .ply files in and out.

Values are kept activated: linear scales, opacities in [0, 1], unit quaternions wxyz.
"""

from __future__ import annotations

import hashlib
import logging
import os
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import plyfile
from numpy.typing import ArrayLike, NDArray

from igaussian_core.camera import Camera
from igaussian_core.errors import MapError
from igaussian_core.render import Rasterizer, Render

log = logging.getLogger(__name__)
Array = NDArray[np.float32]

_SH_COEFFICIENTS = {0: 0, 9: 1, 24: 2, 45: 3}  # number of f_rest properties -> degree
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
    """

    means: Array
    quats_wxyz: Array
    scales: Array
    opacities: Array
    sh: Array
    antialiased: bool = False
    dropped: int = 0
    _rasterizer: Rasterizer | None = field(default=None, repr=False, compare=False)

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        return int(np.sqrt(self.sh.shape[1])) - 1

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
    """Read a Gaussian map from a .ply file.

    INRIA's layout in any order of properties, binary or ascii, float or double, SH degree 0
    to 3, with or without normals and extra properties; Mip-Splatting's filter_3D is applied.

    Raises:
        MapError: missing, truncated, no Gaussian map, or mostly not finite.
    """
    file = Path(path)
    if not file.is_file():
        raise MapError(f"{file}: no such file")
    try:
        ply = plyfile.PlyData.read(str(file))
    except (plyfile.PlyParseError, ValueError, OSError, EOFError, UnicodeDecodeError) as error:
        raise MapError(
            f"{file}: not a readable .ply ({error or type(error).__name__}); "
            "supported: .ply of 3D Gaussians"
        ) from error
    if "vertex" not in ply:
        raise MapError(f"{file}: no element 'vertex'; supported: .ply of 3D Gaussians")
    vertex = ply["vertex"].data
    _check_properties(file, vertex.dtype)
    return _validated(file, _from_vertex(file, vertex, _is_antialiased(ply)))


def save_ply(gmap: GaussianMap, path: str | os.PathLike[str]) -> None:
    """Write INRIA's binary little-endian .ply (float32, no normals)."""
    count, coefficients = len(gmap), gmap.sh.shape[1]
    rest = np.transpose(gmap.sh[:, 1:], (0, 2, 1)).reshape(count, -1)
    opacity = np.clip(gmap.opacities.astype(np.float64), 1e-7, 1 - 1e-7)
    columns: list[tuple[str, NDArray[Any]]] = [
        *zip("xyz", gmap.means.T, strict=True),
        *((f"f_dc_{i}", gmap.sh[:, 0, i]) for i in range(3)),
        *((f"f_rest_{i}", rest[:, i]) for i in range(3 * (coefficients - 1))),
        ("opacity", np.log(opacity / (1 - opacity))),
        *((f"scale_{i}", np.log(np.maximum(gmap.scales[:, i], 1e-30))) for i in range(3)),
        *((f"rot_{i}", gmap.quats_wxyz[:, i]) for i in range(4)),
    ]
    vertex = np.empty(count, dtype=[(name, "<f4") for name, _ in columns])
    for name, values in columns:
        vertex[name] = values
    comments = ["SplatRenderMode: mip"] if gmap.antialiased else []
    element = plyfile.PlyElement.describe(vertex, "vertex")
    plyfile.PlyData([element], byte_order="<", comments=comments).write(str(path))


def file_sha256(path: str | os.PathLike[str]) -> str:
    """Hexadecimal SHA-256 of a file's bytes."""
    with open(path, "rb") as stream:
        return _digest(iter(lambda: stream.read(1 << 20), b""))


def _digest(chunks: Iterable[bytes]) -> str:
    digest = hashlib.sha256()
    for chunk in chunks:
        digest.update(chunk)
    return digest.hexdigest()


def _check_properties(file: Path, dtype: np.dtype[Any]) -> None:
    names = set(dtype.names or ())
    needed = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
    needed += [f"scale_{i}" for i in range(3)] + [f"rot_{i}" for i in range(4)]
    missing = [name for name in needed if name not in names]
    if missing:
        raise MapError(
            f"{file}: no 3D Gaussian map: properties {', '.join(missing)} are missing "
            "(a plain point cloud or mesh cannot be localized against)"
        )
    rest = sum(name.startswith("f_rest_") for name in names)
    if rest not in _SH_COEFFICIENTS:
        raise MapError(
            f"{file}: {rest} f_rest properties; spherical harmonics of degree 0 to 3 have "
            f"{', '.join(map(str, _SH_COEFFICIENTS))}"
        )
    needed += [f"f_rest_{i}" for i in range(rest)]
    unusable = [name for name in needed if name not in names or dtype[name].kind not in "fiu"]
    if unusable:
        raise MapError(f"{file}: properties {', '.join(unusable)} are missing or no plain numbers")


def _is_antialiased(ply: plyfile.PlyData) -> bool:
    return any("splatrendermode: mip" in comment.lower() for comment in ply.comments)


def _from_vertex(file: Path, vertex: NDArray[Any], antialiased: bool) -> GaussianMap:
    def columns(*names: str) -> NDArray[np.float64]:
        return np.stack([np.asarray(vertex[n], np.float64) for n in names], axis=-1)

    rest = sum(name.startswith("f_rest_") for name in vertex.dtype.names or ())
    sh = columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None, :]
    if rest:
        # the file counts channel by channel: f_rest_{c * (K - 1) + k}
        high = columns(*(f"f_rest_{i}" for i in range(rest))).reshape(len(vertex), 3, rest // 3)
        sh = np.concatenate([sh, np.transpose(high, (0, 2, 1))], axis=1)
    with np.errstate(over="ignore", invalid="ignore"):
        scales = np.exp(columns("scale_0", "scale_1", "scale_2"))
        opacities = 1 / (1 + np.exp(-columns("opacity")[:, 0]))
        if "filter_3D" in (vertex.dtype.names or ()):
            scales, opacities = _apply_filter_3d(scales, opacities, columns("filter_3D"))
        return GaussianMap(
            columns("x", "y", "z").astype(np.float32),
            columns("rot_0", "rot_1", "rot_2", "rot_3").astype(np.float32),
            scales.astype(np.float32),
            opacities.astype(np.float32),
            sh.astype(np.float32),
            antialiased,
        )


def _apply_filter_3d(
    scales: NDArray[np.float64], opacities: NDArray[np.float64], filter_3d: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mip-Splatting's 3D smoothing filter (Yu et al., 2024, eq. 9): wider, less opaque."""
    wide = np.sqrt(scales**2 + filter_3d**2)
    return wide, opacities * np.prod(scales / np.maximum(wide, 1e-30), axis=1)


def _validated(file: Path, gmap: GaussianMap) -> GaussianMap:
    """The map without its unusable Gaussians, quaternions of unit length."""
    parts = (gmap.means, gmap.quats_wxyz, gmap.scales, gmap.opacities[:, None])
    norms = np.linalg.norm(gmap.quats_wxyz.astype(np.float64), axis=1)
    good = np.all([np.isfinite(part).all(axis=1) for part in parts], axis=0)
    good &= np.isfinite(gmap.sh).all(axis=(1, 2)) & (norms > 1e-9)
    bad = int(len(gmap) - good.sum())
    if bad > _MAX_BAD_SHARE * len(gmap):
        raise MapError(
            f"{file}: {bad} of {len(gmap)} Gaussians are not finite or have no rotation: "
            "the file is damaged"
        )
    if bad:
        log.warning("%s: left out %d of %d Gaussians (not finite or no rotation)",
                    file, bad, len(gmap))  # fmt: skip
    with np.errstate(invalid="ignore", divide="ignore"):
        quats = (gmap.quats_wxyz / norms[:, None]).astype(np.float32)
    return GaussianMap(
        gmap.means[good], quats[good], gmap.scales[good], gmap.opacities[good], gmap.sh[good],
        gmap.antialiased, bad,
    )  # fmt: skip
