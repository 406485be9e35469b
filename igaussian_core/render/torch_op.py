"""The native renderer as a differentiable torch operator, `igaussian::render`.

Gradients by the Gaussians' parameters and by the 12 free entries of T_cam_scene: a pose optimiser
chains its own parametrisation, e.g. T = exp(twist) @ T0, in front. Float32 tensors on the CPU.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from igaussian_core.camera import Camera
from igaussian_core.errors import MapError
from igaussian_core.render.rasterizer import DEFAULT_NEAR, Rasterizer, check_camera


class _Packed(NamedTuple):
    """The map packed last. It keeps the tensors, so that no other can take their memory."""

    tensors: list[Tensor]
    versions: list[int]
    antialiased: bool
    rasterizer: Rasterizer


_packed: _Packed | None = None


def clear_cache() -> None:
    """Forget the map packed last, and with it the references to its tensors."""
    global _packed
    _packed = None


def _rasterizer(tensors: list[Tensor], antialiased: bool) -> Rasterizer:
    """A Rasterizer of the tensors; the last one again where nothing has changed since."""
    global _packed
    versions = [tensor._version for tensor in tensors]
    if (
        _packed is not None
        and _packed.antialiased == antialiased
        and _packed.versions == versions
        and all(
            old.data_ptr() == new.data_ptr() and old.shape == new.shape
            for old, new in zip(_packed.tensors, tensors, strict=True)
        )
    ):
        return _packed.rasterizer
    means, quats_wxyz, scales, opacities, sh = (tensor.detach().numpy() for tensor in tensors)
    rasterizer = Rasterizer(means, quats_wxyz, scales, opacities, sh, antialiased)
    _packed = _Packed([tensor.detach() for tensor in tensors], versions, antialiased, rasterizer)
    return rasterizer


def _camera(size: list[int], intrinsics: list[float]) -> Camera:
    fx, fy, cx, cy = intrinsics
    return Camera(size[0], size[1], fx, fy, cx, cy)


@torch.library.custom_op("igaussian::render", mutates_args=(), device_types="cpu")
def _render_op(
    means: Tensor,
    quats_wxyz: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh: Tensor,
    T_cam_scene: Tensor,
    size: list[int],
    intrinsics: list[float],
    background: list[float],
    near: float,
    antialiased: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    rasterizer = _rasterizer([means, quats_wxyz, scales, opacities, sh], antialiased)
    render = rasterizer.render(
        _camera(size, intrinsics),
        T_cam_scene.detach().numpy(),
        background=(background[0], background[1], background[2]),
        near=near,
    )
    return (
        torch.from_numpy(render.rgb),
        torch.from_numpy(render.depth),
        torch.from_numpy(render.alpha),
    )


@_render_op.register_fake
def _render_fake(
    means: Tensor,
    quats_wxyz: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh: Tensor,
    T_cam_scene: Tensor,
    size: list[int],
    intrinsics: list[float],
    background: list[float],
    near: float,
    antialiased: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    width, height = size
    return (
        means.new_empty((height, width, 3)),
        means.new_empty((height, width)),
        means.new_empty((height, width)),
    )


@torch.library.custom_op("igaussian::render_backward", mutates_args=(), device_types="cpu")
def _backward_op(
    means: Tensor,
    quats_wxyz: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh: Tensor,
    T_cam_scene: Tensor,
    by_rgb: Tensor,
    by_depth: Tensor,
    by_alpha: Tensor,
    size: list[int],
    intrinsics: list[float],
    background: list[float],
    near: float,
    antialiased: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    tensors = [means, quats_wxyz, scales, opacities, sh]
    gradients = _rasterizer(tensors, antialiased).gradients(
        _camera(size, intrinsics),
        T_cam_scene.detach().numpy(),
        tuple(tensor.detach().numpy() for tensor in tensors),  # type: ignore[arg-type]
        rgb=by_rgb.numpy(),
        depth=by_depth.numpy(),
        alpha=by_alpha.numpy(),
        background=(background[0], background[1], background[2]),
        near=near,
    )
    *by_gaussians, by_camera = (torch.from_numpy(array) for array in gradients)
    return (*by_gaussians, by_camera.to(T_cam_scene.dtype))  # type: ignore[return-value]


@_backward_op.register_fake
def _backward_fake(
    means: Tensor,
    quats_wxyz: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh: Tensor,
    T_cam_scene: Tensor,
    by_rgb: Tensor,
    by_depth: Tensor,
    by_alpha: Tensor,
    size: list[int],
    intrinsics: list[float],
    background: list[float],
    near: float,
    antialiased: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    inputs = (means, quats_wxyz, scales, opacities, sh, T_cam_scene)
    return tuple(torch.empty_like(tensor) for tensor in inputs)  # type: ignore[return-value]


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
    ctx.save_for_backward(*inputs[:6])
    ctx.settings = inputs[6:]


def _backward(ctx: Any, by_rgb: Tensor, by_depth: Tensor, by_alpha: Tensor) -> tuple[Any, ...]:
    images = (by_rgb.contiguous(), by_depth.contiguous(), by_alpha.contiguous())
    gradients = _backward_op(*ctx.saved_tensors, *images, *ctx.settings)
    return (*gradients, *(None for _ in ctx.settings))


_render_op.register_autograd(_backward, setup_context=_setup_context)


def render(
    means: Tensor,
    quats_wxyz: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh: Tensor,
    camera: Camera,
    T_cam_scene: Tensor,
    *,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    near: float = DEFAULT_NEAR,
    antialiased: bool = False,
) -> tuple[Tensor, Tensor, Tensor]:
    """rgb [H, W, 3], depth [H, W] and alpha [H, W] float32, differentiable.

    The map is packed again whenever a tensor has changed; the last one is kept (clear_cache).

    Args:
        means, quats_wxyz, scales, opacities, sh: as `Rasterizer`, float32 CPU tensors.
        camera: pinhole.
        T_cam_scene: [4, 4] float32 or float64, rigid.

    Raises:
        MapError: tensors that are not float32, shapes that do not fit.
        CameraError: as Rasterizer.render.
    """
    tensors = (means, quats_wxyz, scales, opacities, sh)
    if any(tensor.dtype != torch.float32 for tensor in tensors):
        raise MapError(f"renderer: float32 tensors wanted, got {[str(t.dtype) for t in tensors]}")
    check_camera(camera)  # the operator sees no distortion
    return _render_op(
        *(tensor.contiguous() for tensor in tensors),
        T_cam_scene,
        [camera.width, camera.height],
        [camera.fx, camera.fy, camera.cx, camera.cy],
        list(background),
        near,
        antialiased,
    )
