"""Textured rectangles and the solids that they bound: all that the room is made of."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
# painter(canvas) -> colours [rows, cols, 3] in 0..255; see textures.Canvas
Painter = Callable[["Canvas"], NDArray[Any]]

UNIT = 8  # texture sizes are multiples of this, so that cells can be halved three times
COARSE_UNIT = 32  # and of this from WIDE_M on
WIDE_M = 0.3


@dataclass(frozen=True)
class Canvas:
    """What a painter is given: a grid of texels on a rectangle of known size in metres."""

    rows: int
    cols: int
    width: float
    height: float
    rng: np.random.Generator

    def grid(self) -> tuple[Array, Array]:
        """Texel centres in metres from the top-left corner, two arrays [rows, cols]."""
        x = (np.arange(self.cols) + 0.5) * (self.width / self.cols)
        y = (np.arange(self.rows) + 0.5) * (self.height / self.rows)
        return np.meshgrid(x, y)


@dataclass
class Surface:
    """A textured rectangle, seen from one side unless it is two-sided.

    Attributes:
        corner: top-left corner as seen from the visible side, metres, `map` frame.
        edge_u, edge_v: full edges to the right and down, metres.
        texture: uint8 [rows, cols, 3]; rows along edge_v. Albedo until the light is baked in.
        mask: bool [rows, cols], where the surface exists, or None for everywhere.
        emission: radiance of a lamp or window in the units of the light bake (linear RGB).
        importance: weight of its texture when Gaussians are shared out.
        free_edges: its border is a silhouette (furniture), not a corner of the room.
    """

    name: str
    corner: Array
    edge_u: Array
    edge_v: Array
    texture: Image
    mask: NDArray[np.bool_] | None = None
    two_sided: bool = False
    emission: tuple[float, float, float] = (0.0, 0.0, 0.0)
    importance: float = 1.0
    free_edges: bool = True

    @property
    def normal(self) -> Array:
        """Unit normal towards the viewer."""
        n = np.cross(self.edge_v, self.edge_u)
        return n / np.sqrt(np.sum(n * n))

    @property
    def size(self) -> tuple[float, float]:
        """Width and height in metres."""
        return _length(self.edge_u), _length(self.edge_v)

    def points(self, s: Array, t: Array) -> Array:
        """Points [..., 3] at fractions s (right) and t (down) of the rectangle."""
        return self.corner + s[..., None] * self.edge_u + t[..., None] * self.edge_v


@dataclass(frozen=True)
class Solid:
    """An upright box that hides what lies inside it; axes [3, 3] are its rows.

    Not opaque: its face has a mask, so that what lies inside is in the dark but partly seen.
    """

    centre: Array
    axes: Array
    half: Array
    opaque: bool = True

    def contains(self, points: Array, margin: float = 0.0) -> NDArray[np.bool_]:
        """Which of points [..., 3] lie inside the box grown by margin metres."""
        offset = points - self.centre
        inside = np.ones(points.shape[:-1], bool)
        for axis, half in zip(self.axes, self.half, strict=True):
            along = offset[..., 0] * axis[0] + offset[..., 1] * axis[1] + offset[..., 2] * axis[2]
            inside &= np.abs(along) <= half + margin
        return inside


@dataclass
class Room:
    """The analytic room. Size in metres: x in [0, width], y in [0, depth], z in [0, height]."""

    width: float
    depth: float
    height: float
    surfaces: list[Surface] = field(default_factory=list)
    solids: list[Solid] = field(default_factory=list)

    def hidden(self, points: Array) -> NDArray[np.bool_]:
        """Which points [..., 3] lie inside a solid."""
        result = np.zeros(points.shape[:-1], bool)
        for solid in self.solids:
            result |= solid.contains(points)
        return result

    def rectangle(
        self,
        name: str,
        corner: Array,
        edge_u: Array,
        edge_v: Array,
        paint: Painter,
        texel: float = 0.003,
        mask: Callable[[Canvas], NDArray[np.bool_]] | None = None,
        **options: Any,
    ) -> None:
        """Paint a rectangle and add it; texel in metres. Its random numbers follow its name."""
        width, height = _length(edge_u), _length(edge_v)
        rng = np.random.default_rng([2024, zlib.crc32(name.encode())])
        canvas = Canvas(_texels(height, texel), _texels(width, texel), width, height, rng)
        colours = np.clip(np.rint(paint(canvas)), 0, 255).astype(np.uint8)
        self.surfaces.append(
            Surface(
                name,
                np.asarray(corner, float),
                np.asarray(edge_u, float),
                np.asarray(edge_v, float),
                colours,
                mask(canvas) if mask else None,
                **options,
            )
        )

    def box(
        self,
        name: str,
        at: tuple[float, float, float],
        size: tuple[float, float, float],
        paint: Painter | dict[str, Painter],
        faces: str = "front back left right top",
        yaw: float = 0.0,
        **options: Any,
    ) -> None:
        """An upright box standing at `at` (centre of its bottom), turned by yaw degrees.

        Unturned, its front looks towards -y, its right side towards +x. `paint` may be one
        painter or one a face with the key "other" for the rest; unnamed faces are left out.
        """
        ex, ey = _axes(yaw)
        ez = np.array([0.0, 0.0, 1.0])
        base, (lx, ly, lz) = np.array(at), size
        frames = {
            "front": ((-lx, -ly, 2 * lz), ex * lx, -ez * lz),
            "back": ((lx, ly, 2 * lz), -ex * lx, -ez * lz),
            "right": ((lx, -ly, 2 * lz), ey * ly, -ez * lz),
            "left": ((-lx, ly, 2 * lz), -ey * ly, -ez * lz),
            "top": ((-lx, ly, 2 * lz), ex * lx, -ey * ly),
            "bottom": ((-lx, -ly, 0.0), ex * lx, ey * ly),
        }
        for face in faces.split():
            (cx, cy, cz), edge_u, edge_v = frames[face]
            corner = base + (ex * cx + ey * cy + ez * cz) / 2
            painter = paint.get(face, paint["other"]) if isinstance(paint, dict) else paint
            self.rectangle(f"{name}/{face}", corner, edge_u, edge_v, painter, **options)
        half = np.array(size) / 2
        self.solids.append(Solid(base + ez * lz / 2, np.array([ex, ey, ez]), half))

    def prism(
        self,
        name: str,
        at: tuple[float, float, float],
        radius: float,
        height: float,
        paint: Painter,
        sides: int = 10,
        radius_top: float | None = None,
        **options: Any,
    ) -> None:
        """An upright, round thing of flat sides (pot, lamp shade), open above and below."""
        top = radius if radius_top is None else radius_top
        angles = np.round(np.cos(np.arange(sides + 1) * 2 * np.pi / sides), 9)
        sines = np.round(np.sin(np.arange(sides + 1) * 2 * np.pi / sides), 9)
        ring = np.stack([angles, sines], 1)
        widest = max(radius, top)
        taper = None if radius == top else _trapezium(top / widest, radius / widest)
        for i in range(sides):
            a, b = ring[i], ring[i + 1]
            mid = (a + b) / 2
            side = (b - a) * widest
            upper = np.array([*(mid * top), height])
            lower = np.array([*(mid * radius), 0.0])
            edge_u = np.array([side[0], side[1], 0.0])
            corner = np.array(at) + upper - edge_u / 2
            self.rectangle(
                f"{name}/{i}", corner, edge_u, lower - upper, paint, mask=taper, **options
            )
        inner = 0.65 * min(radius, top)
        half = np.array([inner, inner, height / 2])
        centre = np.array(at) + [0.0, 0.0, height / 2]
        self.solids.append(Solid(centre, np.eye(3), half))


def _trapezium(upper: float, lower: float) -> Callable[[Canvas], NDArray[np.bool_]]:
    """Mask of a trapezium; upper and lower are widths relative to the canvas."""

    def mask(canvas: Canvas) -> NDArray[np.bool_]:
        x, y = canvas.grid()
        allowed = upper + (lower - upper) * y / canvas.height
        return np.asarray(np.abs(2 * x / canvas.width - 1) <= allowed)

    return mask


def _length(edge: Array) -> float:
    return float(np.sqrt(np.sum(np.asarray(edge, float) ** 2)))


def _texels(metres: float, texel: float) -> int:
    unit = COARSE_UNIT if metres >= WIDE_M else UNIT
    return max(1, round(metres / texel / unit)) * unit


def _axes(yaw: float) -> tuple[Array, Array]:
    c, s = round(float(np.cos(np.radians(yaw))), 9), round(float(np.sin(np.radians(yaw))), 9)
    return np.array([c, s, 0.0]), np.array([-s, c, 0.0])
