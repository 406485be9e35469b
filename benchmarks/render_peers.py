"""Other renderers of Gaussians on a CPU, timed on one frame where they are installed and run."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np
import torch

from igaussian_core.camera import Camera

Arrays = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def run_peers(arrays: Arrays, camera: Camera, T_cam_scene: np.ndarray) -> list[dict[str, Any]]:
    """One row for each renderer: its CPU milliseconds on one thread, or why there are none."""
    torch.set_num_threads(1)
    return [
        {"name": f"{package} {_version(package)}", "what": what, **_outcome(package, call)}
        for package, what, call in (
            ("gsplat", "torch reference, projection and colours only",
             lambda: _gsplat_projection(arrays, camera, T_cam_scene)),
            ("gsplat", "torch reference, rasterizer",
             lambda: _gsplat_rasterizer(arrays, camera, T_cam_scene)),
            ("splax", "JAX and Warp, whole frame", lambda: _splax(arrays, camera, T_cam_scene)),
            ("gausscam", "WebGPU on a software Vulkan, its own scene", lambda: _gausscam(camera)),
        )
    ]  # fmt: skip


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


def _outcome(package: str, call: Callable[[], Callable[[], Any]]) -> dict[str, Any]:
    if not _version(package):
        return {"reason": "not installed"}
    try:
        frame = call()
        frame()
        start = time.process_time()
        frame()
        return {"cpu_ms": round((time.process_time() - start) * 1e3, 1)}
    except Exception as error:  # whatever a foreign package throws is the finding
        lines = re.sub(r"(?<!\w)/\S*/", "", str(error)).strip().splitlines() or [""]
        return {"reason": f"cannot run: {type(error).__name__}: {lines[0][:150]}"}


def _tensors(arrays: Arrays, camera: Camera, T: np.ndarray) -> tuple[torch.Tensor, ...]:
    """Gaussians, view and intrinsics; these renderers count pixels from the corner."""
    K = np.array([[camera.fx, 0, camera.cx + 0.5], [0, camera.fy, camera.cy + 0.5], [0, 0, 1]])
    views = [torch.tensor(part[None], dtype=torch.float32) for part in (T, K)]
    return (*(torch.tensor(array) for array in arrays), *views)


def _project(arrays: Arrays, camera: Camera, T: np.ndarray) -> tuple[torch.Tensor, ...]:
    from gsplat.cuda import _torch_impl as gsplat

    means, quats, scales, _, sh, view, K = _tensors(arrays, camera, T)
    with torch.no_grad():
        covariances, _ = gsplat._quat_scale_to_covar_preci(quats, scales, True, False)
        radii, uv, z, conics, _ = gsplat._fully_fused_projection(
            means, covariances, view, K, camera.width, camera.height
        )
        eye = torch.linalg.inv(view)[0, :3, 3]
        colours = gsplat._spherical_harmonics(3, means - eye, sh).add(0.5).clamp_min(0)
    return radii, uv, z, conics, colours


def _gsplat_projection(arrays: Arrays, camera: Camera, T: np.ndarray) -> Callable[[], Any]:
    return lambda: _project(arrays, camera, T)


def _gsplat_rasterizer(arrays: Arrays, camera: Camera, T: np.ndarray) -> Callable[[], Any]:
    from gsplat.cuda import _torch_impl as gsplat

    radii, uv, z, conics, colours = _project(arrays, camera, T)
    side = 16
    columns, rows = -(-camera.width // side), -(-camera.height // side)
    _, keys, order = gsplat._isect_tiles(uv, radii, z, side, columns, rows)
    starts = gsplat._isect_offset_encode(keys, 1, columns, rows)
    opacities = torch.tensor(arrays[3])[None]
    return lambda: gsplat._rasterize_to_pixels(
        uv, conics, colours[None], opacities, camera.width, camera.height, side, starts, order
    )


def _splax(arrays: Arrays, camera: Camera, T: np.ndarray) -> Callable[[], Any]:
    import jax.numpy as jnp
    import splax

    means, quats, scales, opacities, sh = (jnp.array(array) for array in arrays)
    logits = jnp.log(opacities / (1 - opacities))
    return lambda: splax.render(
        means,
        jnp.log(scales),
        quats,
        sh,
        logits,
        viewmat=jnp.array(T, jnp.float32),
        background=jnp.zeros(3),
        img_shape=(camera.height, camera.width),
        f=(camera.fx, camera.fy),
        c=(camera.cx + 0.5, camera.cy + 0.5),
        render_depth=True,
    )[0].block_until_ready()


def _gausscam(camera: Camera) -> Callable[[], Any]:
    from gausscam.backends.webgpu import Pipeline, pick_variant
    from gausscam.synthetic import make_scene

    scene = make_scene(seed=0, n=50_000, width=camera.width, height=camera.height, cams=1)
    pipeline = Pipeline(scene, "", variant=pick_variant(""))
    pipeline.set_links(np.zeros((1, 3), np.float32), np.array([[1, 0, 0, 0]], np.float32))
    pipeline.set_cam(scene["cam_pos"], scene["cam_xmat"])
    return pipeline.render_frame
