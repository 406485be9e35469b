"""`Rasterizer`: one map packed for the native kernel, and the frames rendered from it."""

from __future__ import annotations

import ctypes
import math
import os
import weakref
from collections.abc import Collection
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from igaussian_core.camera import Camera
from igaussian_core.errors import CameraError, IGaussianError, MapError
from igaussian_core.render import native_library as native
from igaussian_core.render.native_library import available_simd

__all__ = [
    "DEFAULT_NEAR",
    "OUTPUTS",
    "Rasterizer",
    "Render",
    "RenderGradients",
    "RenderStats",
    "available_simd",
]

OUTPUTS = ("rgb", "depth", "alpha", "median_depth", "ids")
# 3DGS cuts at 0.2 of a unit, which is 20 cm in a metric map: a robot stands closer to things
DEFAULT_NEAR = 0.01
MAX_SIDE = 1 << 15
MAX_GAUSSIANS = 1 << 24  # scene.h: kSplatBits
_CACHE_LINE = 64


class Render(NamedTuple):
    """Images of one view; None where an output was not asked for.

    Attributes:
        rgb: float32 [H, W, 3], 0 to 1 and above where the map's colours are, over background.
        depth: float32 [H, W], expected depth: camera-frame z in scene units, weighted by each
            Gaussian's contribution and divided by alpha; 0 where alpha is 0.
        alpha: float32 [H, W], 0 to 1.
        median_depth: float32 [H, W], z of the Gaussian at which alpha reaches 0.5; 0 where it
            never does.
        ids: int32 [H, W], index of the Gaussian that contributes most; -1 where none does.
    """

    rgb: NDArray[np.float32] | None
    depth: NDArray[np.float32] | None
    alpha: NDArray[np.float32] | None
    median_depth: NDArray[np.float32] | None = None
    ids: NDArray[np.int32] | None = None


class RenderStats(NamedTuple):
    """What the last frame cost.

    Attributes:
        project_ms, sort_ms, blend_ms: busy time summed over threads.
        visible: Gaussians that reach the image.
        entries: (Gaussian, tile) pairs sorted.
        cells: (Gaussian, 4x4 pixels) pairs blended.
    """

    project_ms: float
    sort_ms: float
    blend_ms: float
    visible: int
    entries: int
    cells: int


class RenderGradients(NamedTuple):
    """Gradients of a scalar by the arrays that a Rasterizer was made of, in their shapes
    (float32), and by the entries of T_cam_scene (float64 4x4, last row 0)."""

    means: NDArray[np.float32]
    quats_wxyz: NDArray[np.float32]
    scales: NDArray[np.float32]
    opacities: NDArray[np.float32]
    sh: NDArray[np.float32]
    T_cam_scene: NDArray[np.float64]


class Rasterizer:
    """A map of 3D Gaussians, ready to be rendered; later changes of the arrays have no effect.

    One thread at a time may render with one Rasterizer: frames share its buffers. Use several
    Rasterizers to render from several threads.

    Args:
        means: float32 [N, 3], scene frame.
        quats_wxyz: float32 [N, 4], rotation of each Gaussian's axes into the scene, any length.
        scales: float32 [N, 3], standard deviations along the axes, scene units (not logarithms).
        opacities: float32 [N], 0 to 1.
        sh: float32 [N, K, 3], K = 1, 4, 9 or 16 spherical harmonics; colour = SH + 0.5, at least 0.
        antialiased: scale opacities by sqrt(det S / det (S + 0.3 I)), S the projected covariance,
            for maps trained so (gsplat's "antialiased", after Mip-Splatting).
        simd: instruction set, one of available_simd(); None: IGAUSSIAN_SIMD or the fastest.

    Raises:
        MapError: shapes that do not fit, values that are not finite, opacities outside [0, 1],
            more than 2^24 Gaussians.
        IGaussianError: the instruction set is not available, the library is not built.
    """

    def __init__(
        self,
        means: ArrayLike,
        quats_wxyz: ArrayLike,
        scales: ArrayLike,
        opacities: ArrayLike,
        sh: ArrayLike,
        antialiased: bool = False,
        simd: str | None = None,
    ) -> None:
        arrays = _checked(means, quats_wxyz, scales, opacities, sh)
        self.count = len(arrays[0])
        self.sh_degree = {1: 0, 4: 1, 9: 2, 16: 3}[arrays[4].shape[1]]
        self.antialiased = antialiased
        self.simd = native.choose_simd(simd)
        self.stats: RenderStats | None = None
        lib = native.library()
        self._handle = lib.igaussian_create(
            ctypes.byref(_gaussians(arrays)), int(antialiased), self.simd.encode()
        )
        if not self._handle:
            raise IGaussianError(f"renderer: no memory for {self.count} Gaussians")
        weakref.finalize(self, lib.igaussian_destroy, self._handle)

    def render(
        self,
        camera: Camera,
        T_cam_scene: ArrayLike,
        *,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        near: float = DEFAULT_NEAR,
        threads: int | None = None,
        outputs: Collection[str] = ("rgb", "depth", "alpha"),
    ) -> Render:
        """Images seen by a pinhole camera.

        Args:
            camera: pinhole; pixel (0, 0) has its centre at (0, 0), as cx and cy do.
            T_cam_scene: float64 4x4, rigid, scene to the camera's optical frame.
            background: RGB behind the map.
            near: Gaussians whose centre has z <= near are not drawn.
            threads: None takes every CPU that this process may use. The result does not depend
                on it.
            outputs: names of Render's fields that are wanted.

        Raises:
            CameraError: the camera has distortion (use camera.undistorted()), the image is larger
                than 32768 pixels a side, near is not positive, or T_cam_scene is not rigid.
        """
        frame = _frame(camera, T_cam_scene, background, near, threads)
        images = _allocate(camera, outputs)
        for name, image in images.items():
            setattr(frame, name, _pointer(image))
        if native.library().igaussian_render(self._handle, ctypes.byref(frame)):
            raise IGaussianError(
                f"renderer: no memory for {camera.width}x{camera.height} of {self.count} Gaussians"
            )
        project, sort, blend = frame.nanoseconds
        self.stats = RenderStats(
            project * 1e-6,
            sort * 1e-6,
            blend * 1e-6,
            frame.visible,
            frame.entries,
            frame.cells,
        )
        return _as_render(images)

    def render_batch(
        self,
        camera: Camera,
        T_cam_scene: ArrayLike,
        *,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        near: float = DEFAULT_NEAR,
        threads: int | None = None,
        outputs: Collection[str] = ("rgb", "depth", "alpha"),
    ) -> Render:
        """Many views of one camera, a thread for each: faster than `render` for small images.

        Args:
            T_cam_scene: float64 [B, 4, 4].

        Returns:
            Render whose images have a leading dimension B.

        Raises:
            CameraError: as render.
        """
        poses = np.asarray(T_cam_scene, np.float64)
        if poses.ndim != 3 or poses.shape[1:] != (4, 4):
            raise CameraError(f"renderer: T_cam_scene has shape {poses.shape}, expected [B, 4, 4]")
        images = _allocate(camera, outputs, (len(poses),))
        frames = (native.Frame * max(1, len(poses)))()
        for i, T in enumerate(poses):
            frames[i] = _frame(camera, T, background, near, 1)
            for name, stack in images.items():
                setattr(frames[i], name, _pointer(stack[i]))
        if native.library().igaussian_render_batch(
            self._handle, frames, len(poses), threads or default_threads()
        ):
            raise IGaussianError(f"renderer: no memory for {len(poses)} views")
        return _as_render(images)

    def gradients(
        self,
        camera: Camera,
        T_cam_scene: ArrayLike,
        gaussians: tuple[ArrayLike, ArrayLike, ArrayLike, ArrayLike, ArrayLike],
        *,
        rgb: ArrayLike | None = None,
        depth: ArrayLike | None = None,
        alpha: ArrayLike | None = None,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        near: float = DEFAULT_NEAR,
        threads: int | None = None,
    ) -> RenderGradients:
        """Gradients of a scalar that depends on the images of `render` with the same arguments.

        The order of blending and which Gaussians a pixel skips are taken as fixed, as in 3DGS.

        Args:
            gaussians: the arrays that this Rasterizer was made of (it keeps none of them).
            rgb, depth, alpha: gradients by the images, in their shapes; None where the scalar
                does not depend on one.

        Raises:
            MapError: arrays of another number of Gaussians.
            CameraError: as render, or a gradient that is not of the camera's size.
        """
        arrays = _checked(*gaussians)
        if len(arrays[0]) != self.count:
            raise MapError(f"renderer: {len(arrays[0])} Gaussians, was made of {self.count}")
        frame = _frame(camera, T_cam_scene, background, near, threads)
        size = (camera.height, camera.width)
        by_images = [_gradient(rgb, (*size, 3)), _gradient(depth, size), _gradient(alpha, size)]
        results = [np.zeros_like(array) for array in arrays]
        packed = native.Gradients(
            *(None if image is None else _pointer(image) for image in by_images),
            *(_pointer(result) for result in results),
        )
        if native.library().igaussian_backward(
            self._handle, ctypes.byref(frame), ctypes.byref(_gaussians(arrays)), packed
        ):
            raise IGaussianError(f"renderer: no memory for gradients of {self.count} Gaussians")
        by_camera = np.array(packed.T_cam_scene, np.float64).reshape(4, 4)
        return RenderGradients(*results, by_camera)  # type: ignore[call-arg, arg-type]


def default_threads() -> int:
    """CPUs that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _gaussians(arrays: list[NDArray[np.float32]]) -> native.Gaussians:
    """The arrays as the library takes them; they must outlive the call."""
    return native.Gaussians(
        len(arrays[0]), arrays[4].shape[1], *(_pointer(array) for array in arrays)
    )


def _gradient(image: ArrayLike | None, shape: tuple[int, ...]) -> NDArray[np.float32] | None:
    if image is None:
        return None
    result = np.ascontiguousarray(image, np.float32)
    if result.shape != shape:
        raise CameraError(f"renderer: a gradient has shape {result.shape}, expected {shape}")
    return result


def _frame(
    camera: Camera,
    T_cam_scene: ArrayLike,
    background: tuple[float, float, float],
    near: float,
    threads: int | None,
) -> native.Frame:
    check_camera(camera)
    if not near > 0:
        raise CameraError(f"renderer: near is {near:g}, must be positive")
    return native.Frame(
        width=camera.width,
        height=camera.height,
        threads=threads or default_threads(),
        fx=camera.fx,
        fy=camera.fy,
        cx=camera.cx,
        cy=camera.cy,
        near_plane=near,
        T_cam_scene=(ctypes.c_double * 16)(*_rigid(T_cam_scene).ravel()),
        background=(ctypes.c_float * 3)(*background),
    )


def _pointer(array: NDArray[np.generic]) -> ctypes._Pointer:  # type: ignore[type-arg]
    kind = ctypes.c_int32 if array.dtype == np.int32 else ctypes.c_float
    return ctypes.cast(array.ctypes.data, ctypes.POINTER(kind))


def _checked(*arrays: ArrayLike) -> list[NDArray[np.float32]]:
    names = ("means", "quats_wxyz", "scales", "opacities", "sh")
    result = [np.ascontiguousarray(array, np.float32) for array in arrays]
    count = len(result[0]) if result[0].ndim else 0
    if count > MAX_GAUSSIANS:
        raise MapError(f"renderer: {count} Gaussians; at most {MAX_GAUSSIANS} are supported")
    shapes: list[tuple[int, ...]] = [(count, 3), (count, 4), (count, 3), (count,)]
    for name, array, shape in zip(names, result, shapes, strict=False):
        if array.shape != shape:
            raise MapError(f"renderer: {name} has shape {array.shape}, expected {shape}")
    sh = result[4]
    if sh.ndim != 3 or len(sh) != count or sh.shape[1] not in (1, 4, 9, 16) or sh.shape[2] != 3:
        raise MapError(
            f"renderer: sh has shape {sh.shape}, expected ({count}, K, 3) with K in 1, 4, 9, 16"
        )
    for name, array in zip(names, result, strict=True):
        bad = array.size - int(np.isfinite(array).sum())
        if bad:
            raise MapError(f"renderer: {bad} values of {name} are not finite")
    if count and (result[3].min() < 0 or result[3].max() > 1):
        raise MapError(
            f"renderer: opacities from {result[3].min():g} to {result[3].max():g}, "
            "expected 0 to 1 (not logits)"
        )
    return result


def check_camera(camera: Camera) -> None:
    """Raise CameraError unless the camera can be rendered."""
    if not camera.is_pinhole:
        raise CameraError(
            f"renderer: the camera has {camera.model} distortion; "
            "render with camera.undistorted()"
        )
    if max(camera.width, camera.height) > MAX_SIDE:
        raise CameraError(
            f"renderer: {camera.width}x{camera.height} is larger than {MAX_SIDE} pixels a side"
        )


def _rigid(T: ArrayLike) -> NDArray[np.float64]:
    matrix = np.ascontiguousarray(T, np.float64)
    if matrix.shape != (4, 4):
        raise CameraError(f"renderer: T_cam_scene has shape {matrix.shape}, expected (4, 4)")
    if not np.isfinite(matrix).all():
        raise CameraError("renderer: T_cam_scene has values that are not finite")
    R = matrix[:3, :3]
    skew = float(np.abs(R @ R.T - np.eye(3)).max())
    if skew > 1e-3 or np.linalg.det(R) < 0:
        raise CameraError(
            f"renderer: T_cam_scene is not a rigid transform: R R^T differs from the identity by "
            f"{skew:.2g}, det R is {np.linalg.det(R):.3g}"
        )
    return matrix


def _allocate(
    camera: Camera, outputs: Collection[str], views: tuple[int, ...] = ()
) -> dict[str, NDArray[Any]]:
    unknown = set(outputs) - set(OUTPUTS)
    if unknown:
        raise IGaussianError(
            f"renderer: unknown outputs {sorted(unknown)}; supported: {', '.join(OUTPUTS)}"
        )
    size = (*views, camera.height, camera.width)
    return {
        name: _empty(
            (*size, 3) if name == "rgb" else size, np.int32 if name == "ids" else np.float32
        )
        for name in outputs
    }


def _empty(shape: tuple[int, ...], dtype: type[np.generic]) -> NDArray[Any]:
    """An array of 4-byte items that starts at a cache line, as the kernel writes large images."""
    size = 4 * math.prod(shape)
    memory = np.empty(size + _CACHE_LINE, np.uint8)
    start = -memory.ctypes.data % _CACHE_LINE
    return memory[start : start + size].view(dtype).reshape(shape)


def _as_render(images: dict[str, NDArray[Any]]) -> Render:
    return Render(*(images.get(name) for name in OUTPUTS))
