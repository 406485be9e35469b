"""The Gaussian map: flat Gaussians laid on the room's surfaces, and the .ply file they go to.

Each texture is cut into cells by halving, where the colour varies, until the given number of
Gaussians is used up; each cell becomes one Gaussian, stretched as the cell is. The colours are
then corrected a few times so that the blend of overlapping Gaussians gives the texture's means
(a deconvolution). All in float64 on integer textures: the same bytes on any CPU.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .surfaces import Array, Room, Surface

Ints = NDArray[np.intp]
SH_C0 = 0.28209479177387814  # zeroth spherical harmonic, 1 / (2 sqrt(pi))
SIGMA_FINE, SIGMA_COARSE = 0.58, 0.72  # standard deviation in cell sizes: detail, bare areas
OPACITY = 0.99
THICKNESS = 0.0015  # metres
TOP_CELL, SMALLEST_CELL = 8, 2  # in half-resolution texels
BORDER_FREE, BORDER_SHELL = 0.013, 0.03  # metres across a border
LONGEST = 4  # aspect ratio of a cell
CORRECTIONS = 5


@dataclass(frozen=True)
class Gaussians:
    """Means [N, 3] metres, rotations wxyz [N, 4], scales [N, 3] metres, colours [N, 3] 0..1,
    opacities [N] 0..1.
    """

    means: Array
    quats_wxyz: Array
    scales: Array
    colours: Array
    opacities: Array

    def __len__(self) -> int:
        return len(self.means)


class SurfaceCells:
    """One surface at half resolution, with the sums that give any cell's error at once."""

    def __init__(self, room: Room, surface: Surface) -> None:
        self.surface = surface
        t = surface.texture.astype(np.float64)
        self.target = (t[::2, ::2] + t[1::2, ::2] + t[::2, 1::2] + t[1::2, 1::2]) / (4 * 255)
        rows, cols = self.target.shape[:2]
        self.rows, self.cols = rows, cols
        self.pitch = (surface.size[1] / rows, surface.size[0] / cols)
        self.visible = _visible(room, surface, rows, cols)
        weight = self.visible[..., None].astype(np.float64)
        channels = [weight, weight * self.target, weight * self.target**2]
        sums = np.concatenate(channels, 2).cumsum(0).cumsum(1)
        self.sums = np.pad(sums, ((1, 0), (1, 0), (0, 0)))

    def _totals(self, cells: Ints) -> Array:
        """Sums [N, 7] over cells [N, 4] (row, column, height, width)."""
        r, c, h, w = cells.T
        s = self.sums
        return np.asarray(s[r + h, c + w] - s[r, c + w] - s[r + h, c] + s[r, c])

    def means(self, cells: Ints) -> tuple[Array, Array]:
        """Mean colour [N, 3] of the visible part, and that part's share [N]."""
        totals = self._totals(cells)
        share = totals[:, 0] / (cells[:, 2] * cells[:, 3])
        return totals[:, 1:4] / np.maximum(totals[:, :1], 1e-9), share

    def error(self, cells: Ints) -> Array:
        """Squared colour error [N] times area when each cell has its mean colour."""
        n = self._totals(cells)
        spread = n[:, 4:].sum(1) - (n[:, 1:4] ** 2).sum(1) / np.maximum(n[:, 0], 1e-9)
        return np.maximum(spread, 0) * (self.pitch[0] * self.pitch[1] * self.surface.importance)

    def divide(self, threshold: float) -> Ints:
        """Cells [N, 4], halved until their error is below threshold and borders are fine."""
        cell = TOP_CELL
        while self.rows % cell or self.cols % cell:
            cell //= 2
        r, c = np.meshgrid(
            np.arange(0, self.rows, cell), np.arange(0, self.cols, cell), indexing="ij"
        )
        size = np.full(r.size, cell)
        cells = np.stack([r.ravel(), c.ravel(), size, size], 1)
        done = []
        while len(cells):
            upper, left = _halves(cells, 0), _halves(cells, 1)
            gain_rows = -self.error(upper[0]) - self.error(upper[1])
            gain_cols = -self.error(left[0]) - self.error(left[1])
            force_rows, force_cols = self._forced(cells)
            can_rows, can_cols = _may_split(cells)
            wanted = self.error(cells) > threshold
            by_rows = can_rows & (force_rows | (wanted & ~force_cols))
            by_cols = can_cols & (force_cols | (wanted & ~force_rows))
            both = by_rows & by_cols
            by_rows &= ~both | (gain_rows >= gain_cols)
            by_cols &= ~by_rows
            done.append(cells[~by_rows & ~by_cols])
            cells = np.concatenate(
                [upper[0][by_rows], upper[1][by_rows], left[0][by_cols], left[1][by_cols]]
            )
        result = np.concatenate(done)
        return result[self.means(result)[1] > 0.3]

    def _forced(self, cells: Ints) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Cells to halve whatever their error: at borders, and half hidden ones."""
        r, c, h, w = cells.T
        limit = BORDER_FREE if self.surface.free_edges else BORDER_SHELL
        share = self.means(cells)[1]
        partly = (share > 0) & (share < 1) & (np.maximum(h, w) > 2 * SMALLEST_CELL)
        rows = ((r == 0) | (r + h == self.rows)) & (h * self.pitch[0] > limit)
        cols = ((c == 0) | (c + w == self.cols)) & (w * self.pitch[1] > limit)
        return rows | (partly & (h >= w)), cols | (partly & (w > h))


def _halves(cells: Ints, axis: int) -> tuple[Ints, Ints]:
    first, second = cells.copy(), cells.copy()
    half = cells[:, 2 + axis] // 2
    first[:, 2 + axis] = half
    second[:, 2 + axis] -= half
    second[:, axis] += half
    return first, second


def _may_split(cells: Ints) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    h, w = cells[:, 2], cells[:, 3]
    rows = (h >= 2 * SMALLEST_CELL) & (w < LONGEST * h)
    cols = (w >= 2 * SMALLEST_CELL) & (h < LONGEST * w)
    return rows, cols


def _visible(room: Room, surface: Surface, rows: int, cols: int) -> NDArray[np.bool_]:
    """Which half-resolution texels are in the room, neither masked nor inside a solid."""
    visible = np.ones((rows, cols), bool)
    if surface.mask is not None:
        visible = surface.mask[::2, ::2].copy()
    s, t = np.meshgrid((np.arange(cols) + 0.5) / cols, (np.arange(rows) + 0.5) / rows)
    points = surface.points(s, t) + surface.normal * 0.002
    visible &= np.all((points > 0) & (points < [room.width, room.depth, room.height]), -1)
    low, high = points.min((0, 1)), points.max((0, 1))
    for solid in room.solids:
        if not solid.opaque:
            continue
        reach = (np.abs(solid.axes) * solid.half[:, None]).sum(0)
        if np.all(solid.centre + reach >= low) and np.all(solid.centre - reach <= high):
            visible &= ~solid.contains(points)
    return visible


def build_gaussians(room: Room, budget: int) -> Gaussians:
    """At most budget Gaussians for the lit room."""
    surfaces = [SurfaceCells(room, surface) for surface in room.surfaces]
    threshold = _find_threshold(surfaces, budget)
    divided = [(cells, cells.divide(threshold)) for cells in surfaces]
    parts = [_lay(cells, chosen) for cells, chosen in divided if len(chosen)]
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    return Gaussians(*columns)


def _find_threshold(surfaces: list[SurfaceCells], budget: int) -> float:
    """The smallest error per cell (within 2 %) that the budget allows."""
    low, high = 1e-9, 1e-2
    while high / low > 1.02:
        middle = (low * high) ** 0.5
        count = 0
        for cells in surfaces:
            count += len(cells.divide(middle))
            if count > budget:
                break
        low, high = (middle, high) if count > budget else (low, middle)
    return high


def _sigma(cell: Ints) -> Array:
    """Standard deviation for cells of a size, both in half-resolution texels.

    Narrow Gaussians keep detail but leave gaps, which only show where nothing else is.
    """
    share = np.log2(cell / SMALLEST_CELL) / np.log2(TOP_CELL / SMALLEST_CELL)
    return np.asarray(cell * (SIGMA_FINE + (SIGMA_COARSE - SIGMA_FINE) * share))


def _lay(cells: SurfaceCells, chosen: Ints) -> tuple[Array, Array, Array, Array, Array]:
    """Means, rotations, scales, colours and opacities of one surface's Gaussians."""
    r, c, h, w = chosen.T
    surface, pitch = cells.surface, cells.pitch
    means = surface.points((c + w / 2) / cells.cols, (r + h / 2) / cells.rows)
    flat = np.full(len(r), THICKNESS)
    scales = np.stack([_sigma(w) * pitch[1], _sigma(h) * pitch[0], flat], 1)
    quats = np.tile(quaternion(_axes(surface)), (len(r), 1))
    return means, quats, scales, _corrected(cells, chosen), np.full(len(r), OPACITY)


def _axes(surface: Surface) -> Array:
    """Rotation [3, 3] of a surface's Gaussians: right, down, away from the viewer."""
    axes = np.stack([surface.edge_u, surface.edge_v, -surface.normal], 1)
    return np.asarray(axes / np.sqrt((axes * axes).sum(0)))


def _corrected(cells: SurfaceCells, chosen: Ints) -> Array:
    """Colours [N, 3] whose blend over the surface comes closest to its texture."""
    colours, _ = cells.means(chosen)
    texel, owner, weight = _footprints(cells, chosen)
    count = cells.rows * cells.cols
    target = cells.target.reshape(-1, 3)
    density = np.maximum(np.bincount(texel, weight, count), 1e-6)
    norm = np.maximum(np.bincount(owner, weight, len(chosen)), 1e-9)
    for _ in range(CORRECTIONS):
        for channel in range(3):
            blend = np.bincount(texel, weight * colours[owner, channel], count) / density
            missing = (target[:, channel] - blend)[texel]
            colours[:, channel] += np.bincount(owner, weight * missing, len(chosen)) / norm
        colours = np.clip(colours, 0, 1)
    return colours


def _footprints(cells: SurfaceCells, chosen: Ints) -> tuple[Ints, Ints, Array]:
    """Triplets (texel, Gaussian, weight): where each Gaussian counts, up to 1.5 cells away."""
    texels, owners, weights = [], [], []
    for h, w in np.unique(chosen[:, 2:], axis=0):
        index = np.nonzero((chosen[:, 2] == h) & (chosen[:, 3] == w))[0]
        dy, dx = np.arange(-h, 2 * h), np.arange(-w, 2 * w)
        gy = np.exp(-0.5 * ((dy + 0.5 - h / 2) / _sigma(h)) ** 2)
        gx = np.exp(-0.5 * ((dx + 0.5 - w / 2) / _sigma(w)) ** 2)
        rows = chosen[index, 0][:, None, None] + dy[:, None]
        cols = chosen[index, 1][:, None, None] + dx
        inside = (rows >= 0) & (rows < cells.rows) & (cols >= 0) & (cols < cells.cols)
        flat = rows * cells.cols + cols
        inside[inside] &= cells.visible.ravel()[flat[inside]]
        shape = flat.shape
        weight = np.broadcast_to(np.round(gy[:, None] * gx, 6), shape)
        texels.append(flat[inside])
        owners.append(np.broadcast_to(index[:, None, None], shape)[inside])
        weights.append(weight[inside])
    return np.concatenate(texels), np.concatenate(owners), np.concatenate(weights)


def quaternion(R: Array) -> Array:
    """Unit quaternion wxyz of a rotation matrix, by its largest component (Shepperd)."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = R
    candidates = np.array(
        [
            [1 + xx + yy + zz, zy - yz, xz - zx, yx - xy],
            [zy - yz, 1 + xx - yy - zz, yx + xy, xz + zx],
            [xz - zx, yx + xy, 1 - xx + yy - zz, zy + yz],
            [yx - xy, xz + zx, zy + yz, 1 - xx - yy + zz],
        ]
    )
    best = candidates[int(np.argmax(np.diag(candidates)))]
    return best / np.sqrt(np.sum(best * best))


PLY_FIELDS = (
    "x",
    "y",
    "z",
    "f_dc_0",
    "f_dc_1",
    "f_dc_2",
    "opacity",
    "scale_0",
    "scale_1",
    "scale_2",
    "rot_0",
    "rot_1",
    "rot_2",
    "rot_3",
)


def ply_bytes(gaussians: Gaussians) -> bytes:
    """The map as a 3DGS .ply (binary little endian): log scales, logit opacity, wxyz.

    Normals, which no renderer reads, are left out for size. Values are rounded, so that the
    last bit of an exp or log does not matter.
    """
    count = len(gaussians)
    table = np.column_stack(
        [
            np.round(gaussians.means, 5),
            np.round((gaussians.colours - 0.5) / SH_C0, 4),
            np.round(np.log(gaussians.opacities / (1 - gaussians.opacities)), 4),
            np.round(np.log(gaussians.scales), 4),
            np.round(gaussians.quats_wxyz, 6),
        ]
    )
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    header += [f"property float {name}" for name in PLY_FIELDS] + ["end_header", ""]
    return "\n".join(header).encode("ascii") + table.astype("<f4").tobytes()


def parse_ply(data: bytes) -> Gaussians:
    """The Gaussians of a file that ply_bytes() wrote."""
    header, _, body = data.partition(b"end_header\n")
    if not header.startswith(b"ply\n") or len(body) % (4 * len(PLY_FIELDS)):
        raise ValueError("not a .ply file of this script")
    table = np.frombuffer(body, "<f4").reshape(-1, len(PLY_FIELDS)).astype(np.float64)
    means, colours, logits, scales, quats = np.split(table, [3, 6, 7, 10], 1)
    return Gaussians(
        means, quats, np.exp(scales), colours * SH_C0 + 0.5, 1 / (1 + np.exp(-logits[:, 0]))
    )
