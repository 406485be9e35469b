"""The renderer's oracle: the equations of 3D Gaussian Splatting in plain torch, differentiable.

Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering", 2023, with the
projection of Zwicker et al., "EWA Splatting", 2002. Written for clearness; a tile size only
bounds memory and time, it does not change the result.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from igaussian_core.camera import Camera

ALPHA_MAX = 0.99
ALPHA_MIN = 1 / 255
STOP = 1e-4  # transmittance at which a pixel is finished
LOW_PASS = 0.3  # pixels^2
NEAR = 0.01


class ReferenceRender(NamedTuple):
    """As `igaussian_core.render.Render`, torch tensors of the inputs' dtype."""

    rgb: Tensor  # [H, W, 3]
    depth: Tensor  # [H, W]
    alpha: Tensor  # [H, W]
    median_depth: Tensor  # [H, W]
    ids: Tensor  # [H, W] int64


class Projection(NamedTuple):
    """Gaussians in the image, those in front of the near plane, sorted by depth.

    log_opacity carries the antialiasing factor; extent is half the bounding box of
    alpha >= 1/255, in pixels.
    """

    uv: Tensor  # [M, 2]
    conic: Tensor  # [M, 3] inverse covariance: xx, xy, yy
    opacity: Tensor  # [M]
    colour: Tensor  # [M, 3]
    z: Tensor  # [M]
    extent: Tensor  # [M, 2]
    source: Tensor  # [M] int64, position in the inputs


def rotation_matrices(quats_wxyz: Tensor) -> Tensor:
    """Rotations [N, 3, 3] of quaternions [N, 4] of any length; zero becomes the identity."""
    norm = quats_wxyz.norm(dim=-1, keepdim=True)
    identity = torch.tensor([1.0, 0, 0, 0], dtype=quats_wxyz.dtype)
    unit = torch.where(norm > 0, quats_wxyz / norm.clamp_min(1e-30), identity)
    w, x, y, z = unit.unbind(-1)
    return torch.stack(
        [
            torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        -2,
    )


def sh_basis(directions: Tensor, count: int) -> Tensor:
    """Real spherical harmonics [N, count] of unit directions [N, 3], 3DGS's order and signs."""
    x, y, z = directions.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    basis = [torch.full_like(x, 0.28209479177387814)]
    if count > 1:
        c1 = 0.4886025119029199
        basis += [-c1 * y, c1 * z, -c1 * x]
    if count > 4:
        basis += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * zz - xx - yy),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
        ]
    if count > 9:
        basis += [
            -0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy),
            0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.4570457994644658 * x * (4 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ]
    return torch.stack(basis, -1)


def project(
    means: Tensor,
    quats_wxyz: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh: Tensor,
    camera: Camera,
    T_cam_scene: Tensor,
    *,
    near: float = NEAR,
    antialiased: bool = False,
) -> Projection:
    """Gaussians of `render_reference` projected into the image."""
    R, t = T_cam_scene[:3, :3], T_cam_scene[:3, 3]
    points = means @ R.T + t
    z = points[:, 2].detach()
    index = torch.nonzero(z > near)[:, 0]
    index = index[torch.argsort(z[index], stable=True)]
    points, x = points[index], means[index]
    px, py, pz = points.unbind(-1)
    focal = torch.tensor([camera.fx, camera.fy], dtype=means.dtype)
    centre = torch.tensor([camera.cx, camera.cy], dtype=means.dtype)
    uv = points[:, :2] / pz[:, None] * focal + centre

    # Jacobian of the projection, with x/z and y/z clamped to 1.3 times the field of view (for a
    # principal point off the middle: each side plus 0.3 of the half width)
    half = torch.tensor([camera.width, camera.height], dtype=means.dtype) / 2 / focal
    low = -(centre + 0.5) / focal - 0.3 * half
    high = 2 * half - (centre + 0.5) / focal + 0.3 * half
    tx = torch.minimum(torch.maximum(px / pz, low[0]), high[0])
    ty = torch.minimum(torch.maximum(py / pz, low[1]), high[1])
    zero = torch.zeros_like(pz)
    J = torch.stack(
        [
            torch.stack([camera.fx / pz, zero, -camera.fx * tx / pz], -1),
            torch.stack([zero, camera.fy / pz, -camera.fy * ty / pz], -1),
        ],
        -2,
    )
    L = rotation_matrices(quats_wxyz[index]) * scales[index][:, None, :]
    half_covariance = J @ R @ L
    sharp = half_covariance @ half_covariance.transpose(-1, -2)
    cross = torch.linalg.cross(half_covariance[:, 0], half_covariance[:, 1])
    det_sharp = (cross * cross).sum(-1)  # = det(sharp), without its cancellation
    sxx, sxy, syy = sharp[:, 0, 0], sharp[:, 0, 1], sharp[:, 1, 1]
    det = det_sharp + LOW_PASS * (sxx + syy) + LOW_PASS**2
    sxx, syy = sxx + LOW_PASS, syy + LOW_PASS
    conic = torch.stack([syy, -sxy, sxx], -1) / det[:, None]
    opacity = opacities[index]
    if antialiased:
        opacity = opacity * (det_sharp / det).clamp_min(1e-30).sqrt()

    direction = x + R.T @ t
    direction = direction / direction.norm(dim=-1, keepdim=True)
    basis = sh_basis(direction, sh.shape[1])
    colour = ((basis[:, :, None] * sh[index]).sum(1) + 0.5).clamp_min(0)

    reach = 2 * torch.log(opacity.detach() / ALPHA_MIN).clamp_min(0)
    extent = (reach[:, None] * torch.stack([sxx, syy], -1).detach()).sqrt()
    return Projection(uv, conic, opacity, colour, pz, extent, index)


def weights(p: Projection, pixels: Tensor) -> Tensor:
    """Share [M, P] of each Gaussian in the colour of pixels [P, 2]."""
    d = pixels[None] - p.uv[:, None]  # [M, P, 2]
    dx, dy = d.unbind(-1)
    a, b, c = (p.conic[:, k, None] for k in range(3))
    alpha = p.opacity[:, None] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
    counts = (alpha >= ALPHA_MIN).detach()
    alpha = torch.where(counts, alpha.clamp_max(ALPHA_MAX), 0.0)
    after = torch.cumprod(1 - alpha, 0)
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
    # the Gaussian that would end the pixel is dropped, with all behind it
    return torch.where((after >= STOP).detach(), alpha * before, 0.0)


def _blend(p: Projection, pixels: Tensor, background: Tensor) -> list[Tensor]:
    """rgb [P, 3], depth, alpha, median depth, ids [P] of pixels [P, 2]."""
    weight = weights(p, pixels)
    total = weight.sum(0)
    rgb = torch.einsum("mp,mc->pc", weight, p.colour) + (1 - total)[:, None] * background
    drawn = total > 0
    depth = torch.where(
        drawn, (weight * p.z[:, None]).sum(0) / torch.where(drawn, total, 1.0), 0.0
    )
    median = torch.zeros_like(total)
    ids = torch.full(total.shape, -1, dtype=torch.int64)
    if len(p.z):
        half = torch.cumsum(weight.detach(), 0) >= 0.5
        first = half.to(torch.int8).argmax(0)
        median = torch.where(half.any(0), p.z[first], 0.0)
        ids = torch.where(drawn, p.source[weight.argmax(0)], -1)
    return [rgb, depth, total, median, ids]


class Tile(NamedTuple):
    """One block of pixels and the Gaussians that may show there."""

    height: int
    width: int
    pixels: Tensor  # [height * width, 2]
    gaussians: Projection


def tiles(p: Projection, camera: Camera, side: int) -> Iterator[list[Tile]]:
    """The image in blocks of side x side pixels, row by row."""
    slack = 0.01
    low, high = (p.uv - p.extent).detach() - slack, (p.uv + p.extent).detach() + slack
    for y0 in range(0, camera.height, side):
        y1 = min(y0 + side, camera.height)
        in_row = (high[:, 1] >= y0) & (low[:, 1] <= y1 - 1)
        row = Projection(*(field[in_row] for field in p))
        row_low, row_high = low[in_row, 0], high[in_row, 0]
        tiles_of_row = []
        for x0 in range(0, camera.width, side):
            x1 = min(x0 + side, camera.width)
            here = (row_high >= x0) & (row_low <= x1 - 1)
            y, x = torch.meshgrid(
                torch.arange(y0, y1, dtype=p.z.dtype),
                torch.arange(x0, x1, dtype=p.z.dtype),
                indexing="ij",
            )
            pixels = torch.stack([x.reshape(-1), y.reshape(-1)], -1)
            chosen = Projection(*(field[here] for field in row))
            tiles_of_row.append(Tile(y1 - y0, x1 - x0, pixels, chosen))
        yield tiles_of_row


def render_reference(
    means: Tensor,
    quats_wxyz: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh: Tensor,
    camera: Camera,
    T_cam_scene: Tensor,
    *,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    near: float = NEAR,
    antialiased: bool = False,
    tile: int = 32,
) -> ReferenceRender:
    """Images of Gaussians, as `Rasterizer.render` defines them.

    Args:
        means, quats_wxyz, scales, opacities, sh: as `Rasterizer`, float32 or float64 tensors.
        camera: pinhole.
        T_cam_scene: [4, 4] of the same dtype.
        tile: side of the pixel blocks worked on at a time.
    """
    p = project(
        means,
        quats_wxyz,
        scales,
        opacities,
        sh,
        camera,
        T_cam_scene,
        near=near,
        antialiased=antialiased,
    )
    behind = torch.tensor(background, dtype=means.dtype)
    rows = []
    for row in tiles(p, camera, tile):
        blocks = [
            [
                part.reshape(block.height, block.width, *part.shape[1:])
                for part in _blend(block.gaussians, block.pixels, behind)
            ]
            for block in row
        ]
        rows.append([torch.cat(parts, 1) for parts in zip(*blocks, strict=True)])
    return ReferenceRender(*(torch.cat(parts, 0) for parts in zip(*rows, strict=True)))
