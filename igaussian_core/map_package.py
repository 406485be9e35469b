"""The compiled map: a directory with a manifest, the Gaussians and their landmarks.

    room.igmap/
      manifest.json           version, frames, bounds, hashes; written last
      gaussians.ply           the Gaussians, INRIA layout
      landmarks.safetensors   source views and the 3D points seen in them
      network.safetensors     the pose network trained on the map, where one was

Only data formats are read: opening a map never runs code.
"""

from __future__ import annotations

import dataclasses
import json
import logging
import os
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import load_file, save_file

from igaussian_core.errors import MapError
from igaussian_core.gaussian_map import GaussianMap, file_sha256, load_map, save_ply
from igaussian_core.geometry import Sim3

log = logging.getLogger(__name__)

FORMAT = "igaussian-map"
VERSION = 1

_MANIFEST = "manifest.json"
_GAUSSIANS = "gaussians.ply"
_LANDMARKS = "landmarks.safetensors"
_NETWORK = "network.safetensors"


@dataclass(frozen=True)
class Manifest:
    """What a compiled map says of itself.

    Attributes:
        name: the source file's name without its suffix.
        kind: "object" (views look inward) or "scene" (outward).
        radius: of the spherical views in scene units.
        bounds: corners [2][3] of the box that the map's bulk fills, scene units.
        T_map_scene: 4x4 similarity from the Gaussian file's frame into `map`, metres.
        matcher: the features that the landmarks were made with.
        background: RGB in [0, 1] that lies behind the Gaussians.
        source_file, source_sha256: the file that was compiled.
        gaussians_sha256: of the copy inside the package.
        covariance_scale: what the covariance of a pose is multiplied by in this map.
        covariance_poses: on how many that was measured; 0: not at all.
    """

    name: str
    kind: str
    radius: float
    bounds: list[list[float]]
    T_map_scene: list[list[float]]
    matcher: str
    background: list[float]
    source_file: str
    source_sha256: str
    gaussians_sha256: str
    format: str = FORMAT
    version: int = VERSION
    covariance_scale: float = 1.0
    covariance_poses: int = 0


@dataclass(frozen=True)
class Landmarks:
    """3D points seen in V source views, grouped by view, best score first in each.

    Attributes:
        points: [M, 3] float32 in scene units.
        descriptors: [M, D] float32, L2-normalised (float16 on disk).
        offsets: [V + 1] int64; view v owns the points offsets[v]:offsets[v + 1].
        T_scene_cam: [V, 4, 4] float64 poses of the source views.
        intrinsics: [V, 6] float64: width, height, fx, fy, cx, cy.
    """

    points: NDArray[np.float32]
    descriptors: NDArray[np.float32]
    offsets: NDArray[np.int64]
    T_scene_cam: NDArray[np.float64]
    intrinsics: NDArray[np.float64]

    @property
    def view_count(self) -> int:
        return len(self.T_scene_cam)


@dataclass(frozen=True)
class NetworkData:
    """A trained pose network as it is stored; `coarse.network` knows what it means.

    Attributes:
        tensors: by name.
        meta: text by name.
    """

    tensors: dict[str, NDArray[Any]]
    meta: dict[str, str]


@dataclass(frozen=True)
class MapPackage:
    """A compiled map in memory; `network` is None where none was trained."""

    manifest: Manifest
    gaussians: GaussianMap
    landmarks: Landmarks
    network: NetworkData | None = None

    @property
    def T_map_scene(self) -> Sim3:
        return Sim3.from_matrix(self.manifest.T_map_scene)


def save_package(package: MapPackage, path: str | os.PathLike[str]) -> None:
    """Write the directory as a whole: an older one at `path` is replaced only at the end.

    Raises:
        MapError: `path` exists and is no compiled map, or cannot be written.
    """
    target = Path(path)
    check_target(target)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        staging = Path(tempfile.mkdtemp(prefix=f".{target.name}-", dir=target.parent))
    except OSError as error:
        raise MapError(f"{target}: cannot be written: {error}") from error
    try:
        _write(package, staging)
        staging.chmod(0o755)
        _replace(target, staging)
    except (OSError, SafetensorError) as error:
        raise MapError(f"{target}: cannot be written: {error}") from error
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def is_package(path: str | os.PathLike[str]) -> bool:
    """Whether a path is meant as a compiled map: a folder, unless it is one of another format."""
    return Path(path).is_dir() and not (
        (Path(path) / "meta.json").is_file() and not (Path(path) / _MANIFEST).is_file()
    )


def check_target(path: str | os.PathLike[str]) -> None:
    """Before long work: raise MapError where `save_package` would not overwrite."""
    target = Path(path)
    if target.exists() and not (target / _MANIFEST).is_file():
        raise MapError(f"{target}: exists and is no compiled map; it is left alone")


def _replace(target: Path, staging: Path) -> None:
    """Put a finished directory at `target`; an older one is deleted after that only."""
    if not target.exists():
        staging.rename(target)
        return
    old = staging.with_name(staging.name + "-old")
    target.rename(old)
    staging.rename(target)
    shutil.rmtree(old, ignore_errors=True)


def open_package(path: str | os.PathLike[str]) -> MapPackage:
    """Read a compiled map and check that its parts belong together.

    Raises:
        MapError: missing, of a newer version, altered, incomplete.
    """
    folder = Path(path)
    manifest = _read_manifest(folder)
    ply = folder / _GAUSSIANS
    if not ply.is_file() or file_sha256(ply) != manifest.gaussians_sha256:
        state = "was changed" if ply.is_file() else "is missing"
        raise MapError(f"{ply}: {state} since the map was compiled; compile it again")
    source = folder.parent / manifest.source_file
    if source.is_file() and file_sha256(source) != manifest.source_sha256:
        log.warning("%s: %s was changed since; compile it again to use the new one",
                    folder, source)  # fmt: skip
    return MapPackage(
        manifest, load_map(ply), _read_landmarks(folder / _LANDMARKS),
        _read_network(folder / _NETWORK),
    )  # fmt: skip


def with_T_map_scene(path: str | os.PathLike[str], T_map_scene: Sim3) -> Manifest:
    """Give a compiled map another `T_map_scene`; returns the new manifest.

    Raises:
        MapError: no compiled map, or no similarity (not finite, scale 0).
    """
    folder = Path(path)
    try:
        Sim3.from_matrix(T_map_scene.matrix())
    except ValueError as error:
        raise MapError(f"{folder}: T_map_scene is left as it was: {error}") from error
    manifest = dataclasses.replace(
        _read_manifest(folder), T_map_scene=T_map_scene.matrix().tolist()
    )
    _write_manifest(manifest, folder)
    return manifest


def with_network(path: str | os.PathLike[str], network: NetworkData) -> None:
    """Give a compiled map a trained network, in place of the one that it may have.

    Raises:
        MapError: no compiled map, or it cannot be written.
    """
    folder = Path(path)
    _read_manifest(folder)
    _write_network(network, folder)


def with_covariance_scale(path: str | os.PathLike[str], scale: float, poses: int) -> Manifest:
    """Give a compiled map another `covariance_scale`, measured on so many poses.

    Raises:
        MapError: no compiled map, or a scale that is not positive.
    """
    folder = Path(path)
    if not 0 < scale < np.inf:
        raise MapError(f"{folder}: covariance_scale {scale} is not positive; it is left as it was")
    manifest = dataclasses.replace(
        _read_manifest(folder), covariance_scale=float(scale), covariance_poses=int(poses)
    )
    _write_manifest(manifest, folder)
    return manifest


def _write(package: MapPackage, folder: Path) -> None:
    landmarks = package.landmarks
    save_ply(package.gaussians, folder / _GAUSSIANS)
    _save_tensors(
        folder / _LANDMARKS,
        {
            "points": np.ascontiguousarray(landmarks.points),
            "descriptors": np.ascontiguousarray(landmarks.descriptors.astype(np.float16)),
            "offsets": np.ascontiguousarray(landmarks.offsets),
            "T_scene_cam": np.ascontiguousarray(landmarks.T_scene_cam),
            "intrinsics": np.ascontiguousarray(landmarks.intrinsics),
        },
        {},
    )
    if package.network is not None:
        _write_network(package.network, folder)
    manifest = dataclasses.replace(
        package.manifest, gaussians_sha256=file_sha256(folder / _GAUSSIANS)
    )
    _write_manifest(manifest, folder)


def _write_network(network: NetworkData, folder: Path) -> None:
    temporary = folder / (_NETWORK + ".new")
    try:
        _save_tensors(temporary, network.tensors, network.meta)
        temporary.replace(folder / _NETWORK)
    except (OSError, SafetensorError) as error:
        raise MapError(f"{folder / _NETWORK}: cannot be written: {error}") from error


def _save_tensors(file: Path, tensors: dict[str, NDArray[Any]], meta: dict[str, str]) -> None:
    save_file(tensors, str(file), meta)
    # safetensors keeps its files to their owner; a robot's node may run as another user
    file.chmod(0o644)


def _read_network(file: Path) -> NetworkData | None:
    if not file.is_file():
        return None
    try:
        return read_tensors(file)
    except (OSError, SafetensorError) as error:
        raise MapError(f"{file}: unreadable pose network: {error}") from error


def read_tensors(file: Path) -> NetworkData:
    """All of a safetensors file; raises what safetensors does."""
    with safe_open(str(file), "numpy") as opened:
        tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
        return NetworkData(tensors, opened.metadata() or {})


def _write_manifest(manifest: Manifest, folder: Path) -> None:
    temporary = folder / (_MANIFEST + ".new")
    temporary.write_text(json.dumps(dataclasses.asdict(manifest), indent=1) + "\n")
    temporary.replace(folder / _MANIFEST)


def _read_manifest(folder: Path) -> Manifest:
    file = folder / _MANIFEST
    if not file.is_file():
        hint = "a .ply is compiled first with 'igaussian map compile'"
        what = "no such directory" if not folder.exists() else f"no compiled map (no {_MANIFEST})"
        raise MapError(f"{folder}: {what}; {hint}")
    try:
        data: dict[str, Any] = json.loads(file.read_text())
    except (OSError, ValueError) as error:
        raise MapError(f"{file}: unreadable: {error}") from error
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise MapError(f"{file}: not the manifest of a compiled map")
    if data.get("version") != VERSION:
        raise MapError(
            f"{file}: version {data.get('version')}, this release reads version {VERSION}; "
            "update iGaussian or compile the map again"
        )
    try:
        manifest = Manifest(**data)
        _check_values(manifest)
    except (TypeError, ValueError) as error:
        raise MapError(f"{file}: damaged manifest: {error}") from error
    return manifest


def _check_values(manifest: Manifest) -> None:
    Sim3.from_matrix(manifest.T_map_scene)
    for name in ("name", "kind", "matcher", "source_file", "source_sha256", "gaussians_sha256"):
        if not isinstance(getattr(manifest, name), str):
            raise ValueError(f"{name} is no text")
    for name, shape in (("background", (3,)), ("bounds", (2, 3)), ("radius", ())):
        values = np.asarray(getattr(manifest, name), np.float64)
        if values.shape != shape or not np.isfinite(values).all():
            raise ValueError(f"{name} is not {shape or 'one'} finite numbers")
    if not 0 < float(manifest.covariance_scale) < np.inf:
        raise ValueError("covariance_scale is not positive")


def _read_landmarks(file: Path) -> Landmarks:
    try:
        data = load_file(str(file))
        landmarks = Landmarks(
            data["points"],
            data["descriptors"].astype(np.float32),
            data["offsets"],
            data["T_scene_cam"],
            data["intrinsics"],
        )
    except Exception as error:  # safetensors raises its own unrelated types
        raise MapError(f"{file}: unreadable landmarks: {error}") from error
    counts = (len(landmarks.points), len(landmarks.descriptors), int(landmarks.offsets[-1]))
    if len(set(counts)) != 1 or len(landmarks.offsets) != landmarks.view_count + 1:
        raise MapError(f"{file}: damaged landmarks: sizes {counts} do not belong together")
    return landmarks
