"""Furnished rooms: walls with openings and pictures, floor, ceiling, furniture, clutter."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from igaussian_core.procedural.light import bake, random_lighting
from igaussian_core.procedural.maps import FreeSpace, ProceduralMap
from igaussian_core.procedural.patches import Assembly
from igaussian_core.procedural.splats import lay, random_finish
from igaussian_core.procedural.textures import (
    FLOORS,
    FURNITURE,
    PICTURES,
    WALLS,
    Canvas,
    Image,
    Maker,
    Painter,
    blend,
    books,
    carpet,
    painting,
    plain,
    random_painter,
    random_palette,
    step,
)

Array = NDArray[np.float64]

_TEXEL = 0.022  # metres
_CLEARANCE = 0.3
_GAUSSIANS = (30_000, 40_000)
_TRIES = 12
_LEAST_FREE = 0.25  # share of the room's volume


def make_room(seed: int) -> ProceduralMap:
    """A furnished room of 3 to 8 m, z up, floor at 0; the same for the same seed."""
    builder = _Builder(np.random.default_rng([seed, 1]))
    builder.shell()
    builder.on_walls()
    builder.furnish()
    return builder.finished()


@dataclass(frozen=True)
class _Hanging:
    """Something flat on a wall: width and height, how far below the ceiling, how deep, painters
    of its faces, and the share of light that is its own."""

    size: Array
    top: Callable[[np.random.Generator], float]
    deep: float
    painters: list[Painter]
    glow: float = 0.0


class _Builder:
    """One room while it is put together."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.palette = random_palette(rng)
        # small rooms more often: the Gaussians are spread over all walls
        self.size = np.array([3, 3, 2.3]) + rng.random(3) ** [2, 1.5, 2] * [5, 3.5, 1.1]
        self.parts = Assembly(_TEXEL, rng)
        self.taken: list[tuple[float, float, float, float]] = []  # floor rectangles

    def painter(self, kinds: tuple[Maker, ...] = FURNITURE) -> Painter:
        return random_painter(self.rng, self.palette, kinds)

    # ------------------------------------------------------------ shell
    def shell(self) -> None:
        w, d, h = self.size
        floor, ceiling = self.painter(FLOORS), self.painter((plain,) * 6 + WALLS)
        sheet = partial(self.parts.rectangle, free_edges=False)
        sheet([0, d, 0], [w, 0, 0], [0, -d, 0], floor)
        sheet([0, 0, h], [w, 0, 0], [0, d, 0], ceiling)
        common = self._wall_painter()
        for corner, edge, _ in self._walls():
            painter = common if self.rng.random() < 0.65 else self._wall_painter()
            sheet(corner, edge, [0, 0, -h], painter)
        if self.rng.random() < 0.5:
            self._rug()
        if self.rng.random() < 0.35:
            self._beams()
        if self.rng.random() < 0.3:
            self._bay()
        for _ in range(self.rng.integers(0, 4)):
            self._ceiling_lamp()

    def _walls(self) -> list[tuple[Array, Array, Array]]:
        """Top-left corner, edge to the right, and direction into the room, of the four walls."""
        w, d, h = self.size
        corners = np.array([[0, 0, h], [0, d, h], [w, d, h], [w, 0, h]], float)
        edges = np.roll(corners, -1, axis=0) - corners
        inward = np.array([[1, 0, 0], [0, -1, 0], [-1, 0, 0], [0, 1, 0]], float)
        return list(zip(corners, edges, inward, strict=True))

    def _wall_painter(self) -> Painter:
        """One material, or two with a rail between."""
        upper = self.painter(WALLS)
        if self.rng.random() < 0.6:
            return upper
        lower, rail = self.painter(WALLS), self.palette.pick(self.rng)
        height, width = self.rng.uniform(0.7, 1.5), self.rng.uniform(0.03, 0.1)

        def paint(canvas: Canvas) -> Image:
            _, y = canvas.grid()
            above = canvas.height - y
            image = blend(lower(canvas), upper(canvas), step(above, height, 0.01))
            return blend(image, rail, (np.abs(above - height) < width / 2).astype(np.float32))

        return paint

    def _rug(self) -> None:
        w, d, _ = self.size
        half = self.rng.uniform(0.5, [0.35 * w, 0.35 * d])
        x, y = self.rng.uniform(half, [w, d] - half)
        self.parts.rectangle(
            [x - half[0], y + half[1], 0.012], [2 * half[0], 0, 0], [0, -2 * half[1], 0],
            self.painter((carpet, carpet, *FLOORS)),
        )  # fmt: skip

    def _beams(self) -> None:
        w, d, h = self.size
        painter, count = [self.painter()], int(self.rng.integers(2, 6))
        deep = self.rng.uniform(0.06, 0.14)
        for y in np.linspace(0, d, count + 2)[1:-1]:
            self.parts.box([w / 2, y, h - deep], [w / 2, 0.08, deep], painter, np.eye(3),
                           "+y-y-z")  # fmt: skip

    def _bay(self) -> None:
        """A corner that is not part of the room, up to the ceiling."""
        w, d, h = self.size
        half = self.rng.uniform(0.25, [0.22 * w, 0.22 * d])
        x = half[0] if self.rng.random() < 0.5 else w - half[0]
        y = half[1] if self.rng.random() < 0.5 else d - half[1]
        self.taken.append((x - half[0], x + half[0], y - half[1], y + half[1]))
        self.parts.box([x, y, h / 2], [*half, h / 2], [self._wall_painter()], np.eye(3),
                       "+x-x+y-y", free_edges=False)  # fmt: skip

    def _ceiling_lamp(self) -> None:
        w, d, h = self.size
        x, y = self.rng.uniform(0.5, [w - 0.5, d - 0.5])
        drop, r = self.rng.uniform(0.1, 0.7), self.rng.uniform(0.1, 0.25)
        shade = random_painter(self.rng, self.palette, (plain, *FURNITURE))
        self.parts.lathe([x, y, h - drop], [[0.3 * r, r], [r, -0.4 * r], [0, -0.4 * r]], shade,
                         np.eye(3), glow=0.7)  # fmt: skip
        if drop > 0.3:
            self._rod([x, y, h - drop / 2 + r / 2], 0.012, drop - r)

    def _rod(self, centre: list[float], radius: float, length: float) -> None:
        profile = [[radius, length / 2], [radius, -length / 2]]
        self.parts.lathe(centre, profile, self.painter((plain,)), np.eye(3), least=5)

    # ------------------------------------------------------------ on the walls
    def on_walls(self) -> None:
        for corner, edge, inward in self._walls():
            taken: list[tuple[float, float, float, float]] = []
            length = float(np.linalg.norm(edge))
            hangers = [self._door] * int(self.rng.random() < 0.4)
            hangers += [self._window] * int(self.rng.integers(0, 3))
            hangers += [self._picture] * int(self.rng.integers(1, 8))
            hangers += [self._wall_shelf] * int(self.rng.integers(0, 3))
            for hang in hangers:
                thing = hang()
                width, height = thing.size
                for _ in range(_TRIES):
                    left = self.rng.uniform(0.05, max(0.06, length - width - 0.05))
                    drop = thing.top(self.rng)
                    place = (left, left + width, drop, drop + height)
                    if left + width < length - 0.04 and not _overlaps(place, taken, 0.05):
                        taken.append(place)
                        right = edge / length
                        self._hang(thing, corner + right * left, right, inward, drop)
                        break

    def _hang(
        self, thing: _Hanging, corner: Array, right: Array, inward: Array, drop: float
    ) -> None:
        """Onto a wall, from a corner at the ceiling; its front is its own -y."""
        width, height = thing.size
        middle = corner + right * width / 2 + inward * thing.deep / 2 - [0, 0, drop + height / 2]
        half = [width / 2, thing.deep / 2, height / 2]
        axes = np.stack([right, -inward, [0, 0, 1.0]], axis=1)
        self.parts.box(middle, half, thing.painters, axes, "+x-x-y+z-z", glow=thing.glow,
                       texel=0.013)  # fmt: skip

    def _hung(self, low: float, high: float) -> Callable[[np.random.Generator], float]:
        """Draws how far below the ceiling something's top is."""
        h = self.size[2]
        return lambda rng: float(h - rng.uniform(low, max(low, min(high, h - 0.05))))

    def _door(self) -> _Hanging:
        size = self.rng.uniform([0.75, 1.9], [1.0, 2.15])
        painter = [self.painter((*FURNITURE, painting))]
        return _Hanging(size, lambda rng: self.size[2] - size[1] - 0.001, 0.04, painter)

    def _window(self) -> _Hanging:
        size = self.rng.uniform([0.5, 0.6], [1.9, 1.4])
        panes, frame = self.rng.integers(1, 5, 2), self.palette.pick(self.rng)
        view = random_painter(self.rng, self.palette, (painting,))

        def paint(canvas: Canvas) -> Image:
            x, y = canvas.grid()
            u, v = (x / canvas.width * panes[0]) % 1, (y / canvas.height * panes[1]) % 1
            edge = np.minimum(np.minimum(u, 1 - u) * canvas.width / panes[0],
                              np.minimum(v, 1 - v) * canvas.height / panes[1])  # fmt: skip
            sky = 0.45 + 0.6 * np.clip(view(canvas), 0, 1)
            return blend(frame, sky, (edge > 0.03).astype(np.float32))

        low = min(self.size[2] - 0.1, 0.9 + size[1])
        return _Hanging(size, self._hung(low, low + 0.4), 0.05, [paint], 0.6)

    def _picture(self) -> _Hanging:
        size = self.rng.uniform([0.2, 0.2], [1.0, 0.9]) * self.rng.choice([0.6, 1.0, 1.3])
        painter = [self.painter(PICTURES)]
        deep = self.rng.uniform(0.01, 0.05)
        return _Hanging(size, self._hung(size[1] + 0.7, 2.4), deep, painter)

    def _wall_shelf(self) -> _Hanging:
        size = self.rng.uniform([0.5, 0.25], [1.4, 1.1])
        deep = self.rng.uniform(0.12, 0.3)
        painter = [books(self.rng, self.palette, 1.0)]
        return _Hanging(size, self._hung(1.3, 2.3), deep, painter)

    # ------------------------------------------------------------ furniture
    def furnish(self) -> None:
        kinds = [self._table, self._cupboard, self._chair, self._sofa, self._bookcase,
                 self._plant, self._drum, self._stool, self._heap, self._machine]  # fmt: skip
        area = self.size[0] * self.size[1]
        wanted = int(self.rng.uniform(0.25, 0.65) * area)
        favoured = self.rng.permutation(len(kinds))[: self.rng.integers(4, len(kinds) + 1)]
        for _ in range(max(4, wanted)):
            kind = kinds[self.rng.choice(favoured)]
            self._place(kind)
            if self._space().share(np.random.default_rng(0)) < _LEAST_FREE:
                break

    def _place(self, kind: Callable[[Array, Array, Array], None]) -> None:
        """Put one piece against a wall, or anywhere, where there is room."""
        w, d, _ = self.size
        half = self.rng.uniform([0.2, 0.2], [0.8, 0.45])
        for _ in range(_TRIES):
            yaw = float(self.rng.choice([0, 0.5, 1, 1.5])) * np.pi
            loose = self.rng.random() < 0.4
            if loose and self.rng.random() < 0.5:
                yaw += self.rng.uniform(-0.8, 0.8)
            rotation = _yaw(yaw)
            reach = np.abs(rotation[:2, :2]) @ half
            spot = self.rng.uniform(reach, np.maximum([w, d] - reach, reach + 1e-3))
            if not loose:  # its back, own +y, against the wall
                back = rotation[:2, 1]
                axis = int(np.argmax(np.abs(back)))
                spot[axis] = ([w, d] - reach)[axis] if back[axis] > 0 else reach[axis]
            x, y = spot
            place = (x - reach[0], x + reach[0], y - reach[1], y + reach[1])
            if not _overlaps(place, self.taken, 0.06):
                self.taken.append(place)
                kind(np.array([x, y, 0.0]), half, rotation)
                return

    def _at(self, base: Array, rotation: Array, x: float, y: float, z: float) -> Array:
        return np.asarray(base + rotation @ [x, y, z])

    def _box(self, base: Array, rotation: Array, low: list[float], high: list[float],
             painters: list[Painter]) -> None:  # fmt: skip
        """A box from its own corners, about a piece of furniture's place."""
        a, b = np.array(low, float), np.array(high, float)
        self.parts.box(base + rotation @ ((a + b) / 2), (b - a) / 2, painters, rotation,
                       texel=0.015)  # fmt: skip

    def _legs(self, base: Array, half: Array, rotation: Array, height: float) -> None:
        painter, r = [self.painter((plain, plain, *FURNITURE))], self.rng.uniform(0.02, 0.045)
        for x in (-half[0] + r, half[0] - r):
            for y in (-half[1] + r, half[1] - r):
                self._box(base, rotation, [x - r, y - r, 0], [x + r, y + r, height], painter)

    def _table(self, base: Array, half: Array, rotation: Array) -> None:
        height, thick = self.rng.uniform(0.45, 0.95), self.rng.uniform(0.03, 0.08)
        self._legs(base, half, rotation, height - thick)
        self._box(base, rotation, [-half[0], -half[1], height - thick], [*half, height],
                  [self.painter()])  # fmt: skip
        self._clutter(base, half, rotation, height)

    def _cupboard(self, base: Array, half: Array, rotation: Array) -> None:
        height = self.rng.uniform(0.5, min(2.2, self.size[2] - 0.1))
        sides, front = self.painter(), self.painter((*FURNITURE, *PICTURES))
        self._box(base, rotation, [-half[0], -half[1], 0], [*half, height],
                  [sides, sides, sides, front, sides, sides])  # fmt: skip
        if self.rng.random() < 0.6 and height < 1.5:
            self._clutter(base, half, rotation, height)

    def _bookcase(self, base: Array, half: Array, rotation: Array) -> None:
        half = np.minimum(half, [0.8, 0.25])
        height = self.rng.uniform(0.9, min(2.2, self.size[2] - 0.1))
        sides, front = self.painter(), books(self.rng, self.palette, 1.0)
        self._box(base, rotation, [-half[0], -half[1], 0], [*half, height],
                  [sides, sides, front, front, sides, sides])  # fmt: skip

    def _chair(self, base: Array, half: Array, rotation: Array) -> None:
        half = np.minimum(half, 0.27)
        seat, back = self.rng.uniform(0.4, 0.5), self.rng.uniform(0.75, 1.1)
        self._legs(base, half, rotation, seat - 0.05)
        painter = [self.painter()]
        self._box(base, rotation, [-half[0], -half[1], seat - 0.05], [*half, seat], painter)
        self._box(base, rotation, [-half[0], half[1] - 0.05, seat], [*half, back], painter)

    def _sofa(self, base: Array, half: Array, rotation: Array) -> None:
        half = np.maximum(half, [0.6, 0.35])
        cloth, arm = [self.painter()], 0.14
        w, d = half
        self._box(base, rotation, [-w, -d, 0], [w, d, 0.42], cloth)
        self._box(base, rotation, [-w, d - 0.18, 0.42], [w, d, 0.85], cloth)
        for x in (-w, w - arm):
            self._box(base, rotation, [x, -d, 0.42], [x + arm, d - 0.18, 0.62], cloth)
        for _ in range(self.rng.integers(0, 4)):
            x = self.rng.uniform(-w + 0.3, w - 0.3)
            self.parts.blob(
                self._at(base, rotation, x, d - 0.3, 0.6), [0.2, 0.09, 0.18],
                [self.painter((*FURNITURE, *PICTURES))], rotation, 3.0, texel=0.015,
            )  # fmt: skip

    def _plant(self, base: Array, half: Array, rotation: Array) -> None:
        r, pot = self.rng.uniform(0.1, 0.22), self.rng.uniform(0.2, 0.5)
        profile = np.array([[0.05, pot * 0.9], [r, pot], [r * 0.7, 0], [0, 0]])
        self.parts.lathe(base, profile, self.painter(), rotation, texel=0.015)
        green = self.rng.uniform([0.05, 0.2, 0.03], [0.35, 0.6, 0.25])
        crown = base + [0, 0, pot + self.rng.uniform(0.2, 0.6)]
        self._rod([*base[:2], (crown[2] + pot) / 2], 0.015, crown[2] - pot)
        middles = crown + self.rng.normal(0, 0.16, (self.rng.integers(15, 50), 3))
        middles = np.clip(middles, 0.06, self.size - 0.06)
        solid = self.parts.solid(middles)
        for middle in middles:
            self._leaf(middle, green * self.rng.uniform(0.6, 1.5), solid)

    def _leaf(self, middle: Array, green: Array, solid: int) -> None:
        u, v = self.rng.normal(0, 0.09, 3), self.rng.normal(0, 0.05, 3)
        tone = np.clip(green, 0, 1).astype(np.float32)
        self.parts.rectangle(
            middle - (u + v) / 2, u, v, lambda canvas: blend(tone, tone, canvas.grid()[0]),
            texel=0.03, two_sided=True, solid=solid,
            mask=lambda s, t: (s - 0.5) ** 2 + (t - 0.5) ** 2 < 0.25,
        )  # fmt: skip

    def _drum(self, base: Array, half: Array, rotation: Array) -> None:
        """Vases, bins, columns, lamps on a stand: anything turned on a lathe."""
        h = self.rng.uniform(0.3, 1.7)
        knots = int(self.rng.integers(2, 6))
        r = self.rng.uniform(0.25, 1.0, knots) * min(half.min(), 0.45)
        z = np.linspace(h, 0, knots)
        profile = np.concatenate([[[0, h]], np.stack([r, z], 1), [[0, 0]]])
        self.parts.lathe(base, profile, self.painter((*FURNITURE, *PICTURES)), rotation, 14,
                         texel=0.015)  # fmt: skip

    def _stool(self, base: Array, half: Array, rotation: Array) -> None:
        h, r = self.rng.uniform(0.4, 0.9), min(half.min(), 0.45)
        self._rod([*base[:2], h / 2], 0.03, h)
        for z, radius in ((h, r), (0.03, 0.6 * r)):
            profile = [[0, 0], [radius, 0], [radius, -0.04], [0, -0.04]]
            self.parts.lathe(base + [0, 0, z], profile, self.painter(), rotation, 14, texel=0.015)

    def _heap(self, base: Array, half: Array, rotation: Array) -> None:
        """Cartons upon each other."""
        z = 0.0
        for _ in range(self.rng.integers(1, 5)):
            size = half * self.rng.uniform(0.5, 0.9) * [1, 1]
            high = self.rng.uniform(0.12, 0.5)
            turn = rotation @ _yaw(self.rng.normal(0, 0.15))
            painters = [self.painter((*FURNITURE, *PICTURES)) for _ in range(3)]
            self._box(base, turn, [-size[0], -size[1], z], [*size, z + high], painters)
            z += high

    def _machine(self, base: Array, half: Array, rotation: Array) -> None:
        """Something tall on a foot: a screen, a cooker with its hood, a statue."""
        high = self.rng.uniform(0.4, 1.2)
        self._box(base, rotation, [-half[0], -half[1], 0], [*half, high],
                  [self.painter(), self.painter(PICTURES)])  # fmt: skip
        middle = self._at(base, rotation, 0, 0, high + 0.3)
        size = self.rng.uniform([0.15, 0.04, 0.2], [0.45, 0.3, 0.3])
        self.parts.blob(middle, np.minimum(size, [*half, 1]), [self.painter(PICTURES)], rotation,
                        float(self.rng.choice([2.0, 2.5, 6.0])), float(self.rng.choice([0, 0.15])),
                        texel=0.015)  # fmt: skip

    def _clutter(self, base: Array, half: Array, rotation: Array, height: float) -> None:
        """Small things on a top."""
        for _ in range(self.rng.integers(0, 6)):
            x, y = self.rng.uniform(-half, half) * 0.8
            place, kind = self._at(base, rotation, x, y, height), self.rng.integers(3)
            size = self.rng.uniform(0.04, 0.16, 3)
            turn = rotation @ _yaw(self.rng.uniform(0, 3))
            painter = self.painter((*FURNITURE, *PICTURES))
            if kind == 0:
                self.parts.box(place + [0, 0, size[2]], size, [painter], turn, texel=0.012)
            elif kind == 1:
                self.parts.blob(place + [0, 0, size[2]], size, [painter], turn, texel=0.012)
            else:
                r, z = size[:2].mean(), 3 * size[2]
                profile = [[0, z], [0.6 * r, z], [r, 0.5 * z], [0.8 * r, 0], [0, 0]]
                self.parts.lathe(place, profile, painter, turn, texel=0.012)

    # ------------------------------------------------------------ done
    def _space(self) -> FreeSpace:
        low = np.array(self.parts.low).reshape(-1, 3)
        high = np.array(self.parts.high).reshape(-1, 3)
        return FreeSpace(np.zeros(3), self.size, low, high, _CLEARANCE)

    def finished(self) -> ProceduralMap:
        bake(self.parts, random_lighting(self.rng, np.zeros(3), self.size, self.size))
        budget = int(self.rng.uniform(*_GAUSSIANS))
        detail = np.where(self.rng.random(len(self.parts.patches)) < 0.1, 0.15, 1.0)
        gmap = lay(self.parts.patches, budget, detail, random_finish(self.rng), self.rng)
        free = self._space()
        places = free.draw(np.random.default_rng(0), 32)
        centre = places[np.argmin(np.linalg.norm(places - self.size / 2, axis=1))]
        return ProceduralMap(gmap, "scene", (0.0, 0.0, 1.0), centre, 0.1, free)


def _yaw(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


def _overlaps(
    place: tuple[float, float, float, float], taken: list[tuple[float, float, float, float]],
    margin: float,
) -> bool:  # fmt: skip
    a0, a1, b0, b1 = place
    return any(
        a0 < c1 + margin and c0 < a1 + margin and b0 < d1 + margin and d0 < b1 + margin
        for c0, c1, d0, d1 in taken
    )
