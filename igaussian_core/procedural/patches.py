"""Textured surface patches, and the solids that are made of them.

A patch is a function of (s, t) in [0, 1]: s to the right and t down as its visible side is seen,
so that d/ds x d/dt points away from the viewer.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from igaussian_core.procedural.textures import Canvas, Image, Painter

Array = NDArray[np.float64]
# (s, t), arrays of one shape -> points [..., 3]
Surface = Callable[[Array, Array], Array]
# corners [N, 2] of a closed polygon, counter-clockwise
Polygon = Array

_TOP_LEVEL = 4  # a cell spans at most 2^4 texels
_MAX_TEXELS = 320  # a side


@dataclass
class Patch:
    """One textured piece of surface.

    Attributes:
        at: its points.
        size: length along s and along t, metres.
        texture: [rows, cols, 3] float32; albedo until the light is baked in.
        mask: [rows, cols], where the surface exists, or None for everywhere.
        levels: halvings of the largest cells.
        solid: index of the solid it belongs to, -1 for none.
        free_edges: its border is a silhouette, and wants small Gaussians.
        glow: share of the light that is its own.
        two_sided: seen, and lit, from both sides.
    """

    at: Surface
    size: tuple[float, float]
    texture: Image
    mask: NDArray[np.bool_] | None = None
    levels: int = 0
    solid: int = -1
    free_edges: bool = True
    glow: float = 0.0
    two_sided: bool = False


@dataclass
class Assembly:
    """What a map is made of, before it becomes Gaussians.

    Attributes:
        texel: size of a texture's texel in metres.
        rng: of the textures.
        low, high: boxes [N][3] around the solids, for shadows and free space.
    """

    texel: float
    rng: np.random.Generator
    patches: list[Patch] = field(default_factory=list)
    low: list[Array] = field(default_factory=list)
    high: list[Array] = field(default_factory=list)

    def solid(self, corners: Array) -> int:
        """A new solid inside the box around corners [N, 3]."""
        self.low.append(corners.min(axis=0))
        self.high.append(corners.max(axis=0))
        return len(self.low) - 1

    def add(
        self,
        at: Surface,
        size: tuple[float, float],
        painter: Painter,
        least_cells: tuple[int, int] = (1, 1),
        mask: Callable[[Array, Array], NDArray[np.bool_]] | None = None,
        texel: float | None = None,
        **options: float | bool | int,
    ) -> Patch:
        """One patch, painted.

        Args:
            least_cells: Gaussians along s and t at least: curved surfaces need them.
            mask: where the surface exists, of texel centres (s, t).
        """
        texel = texel or self.texel
        cols, rows = (int(np.clip(round(length / texel), 1, _MAX_TEXELS)) for length in size)
        cols, rows = max(cols, least_cells[0]), max(rows, least_cells[1])
        spare = min(cols / least_cells[0], rows / least_cells[1])
        levels = int(np.clip(np.floor(np.log2(spare)), 0, _TOP_LEVEL))
        unit = 2**levels
        cols, rows = -(-cols // unit) * unit, -(-rows // unit) * unit
        texture = painter(Canvas(rows, cols, size[0], size[1], self.rng))
        cut = None
        if mask is not None:
            s, t = np.meshgrid((np.arange(cols) + 0.5) / cols, (np.arange(rows) + 0.5) / rows)
            cut = mask(s, t)
        patch = Patch(at, size, np.asarray(texture, np.float32), cut, levels, **options)  # type: ignore[arg-type]
        self.patches.append(patch)
        return patch

    def rectangle(
        self, corner: ArrayLike, edge_u: ArrayLike, edge_v: ArrayLike, painter: Painter,
        **options: object,
    ) -> Patch:
        """A flat patch from its top-left corner, edges to the right and down."""
        o, u, v = (np.asarray(a, np.float64) for a in (corner, edge_u, edge_v))
        size = float(np.linalg.norm(u)), float(np.linalg.norm(v))
        at = lambda s, t: o + s[..., None] * u + t[..., None] * v  # noqa: E731
        return self.add(at, size, painter, **options)  # type: ignore[arg-type]

    def box(
        self, centre: ArrayLike, half: ArrayLike, painters: list[Painter], rotation: Array,
        faces: str = "+x-x+y-y+z-z", **options: object,
    ) -> int:
        """A box; its faces take the painters in turn. Returns the solid's index."""
        c, h = np.asarray(centre, np.float64), np.asarray(half, np.float64)
        signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
        solid = self.solid(c + (signs * h) @ rotation.T)
        for index, (axis, sign) in enumerate((a, s) for a in range(3) for s in (1, -1)):
            if "-+"[(sign + 1) // 2] + "xyz"[axis] not in faces:
                continue
            u, v = _face_axes(axis, sign)
            n = np.eye(3)[axis] * sign
            o = rotation @ (h * (n - u - v)) + c
            self.rectangle(
                o, rotation @ (2 * h * u), rotation @ (2 * h * v),
                painters[index % len(painters)], solid=solid, **options,
            )  # fmt: skip
        return solid

    def lathe(
        self, centre: ArrayLike, profile: ArrayLike, painter: Painter, rotation: Array,
        least: int = 10, squash: float = 1.0, **options: object,
    ) -> int:
        """A solid of revolution about its own z axis.

        Args:
            profile: (radius, z) [N, 2] from the top to the bottom.
            squash: of its own y axis.
        """
        c, p = np.asarray(centre, np.float64), np.asarray(profile, np.float64)
        lengths = np.maximum(np.linalg.norm(np.diff(p, axis=0), axis=1), 1e-9)
        knots = np.concatenate([[0], np.cumsum(lengths)])
        radius, low, high = p[:, 0].max(), p[:, 1].min(), p[:, 1].max()
        r = np.array([radius, radius * squash])
        signs = np.array(np.meshgrid([-1, 1], [-1, 1], [low, high])).reshape(3, -1).T
        solid = self.solid(c + (signs * [*r, 1]) @ rotation.T)
        for first, length in enumerate(lengths):
            if length < 1e-6:
                continue

            def at(s: Array, t: Array, first: int = first, length: float = length) -> Array:
                along = knots[first] + t * length
                ring, z = np.interp(along, knots, p[:, 0]), np.interp(along, knots, p[:, 1])
                angle = 2 * np.pi * s
                local = [ring * np.cos(angle), squash * ring * np.sin(angle), z]
                return c + np.stack(local, -1) @ rotation.T

            around = 2 * np.pi * float(p[first : first + 2, 0].mean())
            self.add(
                at, (around, float(length)), painter, (least, 1), solid=solid, **options,  # type: ignore[arg-type]
            )  # fmt: skip
        return solid

    def blob(
        self, centre: ArrayLike, half: ArrayLike, painters: list[Painter], rotation: Array,
        power: float = 2.0, bumps: float = 0.0, least: int = 4, **options: object,
    ) -> int:
        """A superellipsoid |x|^p + |y|^p + |z|^p = 1, with waves on it if wanted."""
        c, h = np.asarray(centre, np.float64), np.asarray(half, np.float64)
        waves = self.rng.normal(0, 2.5, (3, 3))
        phase = self.rng.uniform(0, 6, 3)
        signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
        solid = self.solid(c + (signs * h) @ rotation.T)
        for index, (axis, sign) in enumerate((a, s) for a in range(3) for s in (1, -1)):
            u, v = _face_axes(axis, sign)
            n = np.eye(3)[axis] * sign

            def at(s: Array, t: Array, u: Array = u, v: Array = v, n: Array = n) -> Array:
                # tangents make the six faces' cells alike in size
                a, b = np.tan((s - 0.5) * np.pi / 2), np.tan((t - 0.5) * np.pi / 2)
                d = n + a[..., None] * u + b[..., None] * v
                d = d / (np.abs(d) ** power).sum(-1, keepdims=True) ** (1 / power)
                d = d * (1 + bumps * np.sin(d @ waves.T + phase).mean(-1, keepdims=True))
                return np.asarray(c + (d * h) @ rotation.T)

            size = 1.6 * float(h @ np.abs(u)), 1.6 * float(h @ np.abs(v))
            self.add(
                at, size, painters[index % len(painters)], (least, least), solid=solid,
                free_edges=False, **options,  # type: ignore[arg-type]
            )  # fmt: skip
        return solid

    def tube(
        self, curve: Callable[[Array], Array], radius: float, painter: Painter, least: int = 24,
        around: int = 6, **options: object,
    ) -> int:
        """A tube about a curve of points [..., 3] for parameters in [0, 1]: rings, handles."""
        steps = curve(np.linspace(0, 1, 33))
        solid = self.solid(np.concatenate([steps - radius, steps + radius]))
        length = float(np.linalg.norm(np.diff(steps, axis=0), axis=1).sum())

        def at(s: Array, t: Array) -> Array:
            along = curve(np.clip(s + 1e-3, 0, 1)) - curve(np.clip(s - 1e-3, 0, 1))
            along = along / np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-12)
            # any fixed direction that is nowhere along the curve would do; this one rarely is
            side = np.cross(along, np.array([0.311, 0.177, 0.934]))
            side = side / np.maximum(np.linalg.norm(side, axis=-1, keepdims=True), 1e-9)
            up = np.cross(along, side)
            angle = 2 * np.pi * t[..., None]
            return curve(s) + radius * (np.cos(angle) * side + np.sin(angle) * up)

        self.add(
            at, (length, 2 * np.pi * radius), painter, (least, around), solid=solid,
            **options,  # type: ignore[arg-type]
        )  # fmt: skip
        return solid

    def prism(
        self, centre: ArrayLike, outline: Polygon, height: float, painters: list[Painter],
        rotation: Array, **options: object,
    ) -> int:
        """A polygon in the own xy plane, extruded by +-height / 2."""
        c, p = np.asarray(centre, np.float64), np.asarray(outline, np.float64)
        h = height / 2
        ends = np.concatenate([np.c_[p, np.full(len(p), z)] for z in (h, -h)])
        solid = self.solid(c + ends @ rotation.T)
        for a, b in zip(p, np.roll(p, -1, axis=0), strict=True):
            self.rectangle(
                rotation @ [*a, h] + c, rotation @ [*(b - a), 0], rotation @ [0, 0, -height],
                painters[0], solid=solid, **options,
            )  # fmt: skip
        low, extent = p.min(axis=0), np.ptp(p, axis=0)
        for up in (True, False):

            def inside(s: Array, t: Array, up: bool = up) -> NDArray[np.bool_]:
                return contains(p, low + np.stack([s, 1 - t if up else t], -1) * extent)

            corner = [low[0], low[1] + up * extent[1], h if up else -h]
            down = [0, -extent[1] if up else extent[1], 0]
            self.rectangle(
                rotation @ corner + c, rotation @ [extent[0], 0, 0], rotation @ down,
                painters[-1], solid=solid, mask=inside, **options,
            )  # fmt: skip
        return solid


def contains(polygon: Polygon, points: Array) -> NDArray[np.bool_]:
    """Whether points [..., 2] are inside a polygon (crossing number)."""
    x, y = points[..., 0], points[..., 1]
    inside = np.zeros(x.shape, bool)
    for (x0, y0), (x1, y1) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if y0 != y1:
            crosses = (y0 > y) != (y1 > y)
            inside ^= crosses & (x < (x1 - x0) * (y - y0) / (y1 - y0) + x0)
    return inside


def _face_axes(axis: int, sign: int) -> tuple[Array, Array]:
    """Directions right and down of a box's face, seen from outside."""
    if axis == 2:
        return np.eye(3)[0], -sign * np.eye(3)[1]
    down = np.array([0.0, 0.0, -1.0])
    return np.cross(np.eye(3)[axis] * sign, down), down
