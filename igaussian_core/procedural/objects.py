"""Objects: composites of many textured solids, symmetrical or not, studded, thin, or round."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from igaussian_core.geometry import rotation_from_vector
from igaussian_core.procedural.light import bake, random_lighting
from igaussian_core.procedural.maps import ProceduralMap
from igaussian_core.procedural.patches import Assembly
from igaussian_core.procedural.splats import lay, random_finish
from igaussian_core.procedural.textures import (
    ALL,
    FLOORS,
    FURNITURE,
    Maker,
    Painter,
    Palette,
    plain,
    random_painter,
    random_palette,
)

Array = NDArray[np.float64]

RADIUS = 4.0  # where the cameras are, scene units
HALF_VIEW = np.radians(19.5)
_TEXEL = 0.025
_UNIT = 0.6  # size of patterns against those of rooms
_GAUSSIANS = (14_000, 34_000)


def make_object(seed: int) -> ProceduralMap:
    """An object about the origin, z up, seen whole from 4 units; the same for the same seed."""
    builder = _Builder(np.random.default_rng([seed, 2]))
    if builder.rng.random() < 0.55:
        builder.ground()
    plans = [builder.pile, builder.tower, builder.studded, builder.vehicle, builder.flower]
    for index in builder.rng.permutation(len(plans))[: builder.rng.integers(1, 3)]:
        plans[index]()
    builder.details()
    return builder.finished()


class _Builder:
    """One object while it is put together, within about 1 unit of the origin."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.palette: Palette = random_palette(rng)
        self.parts = Assembly(_TEXEL, rng)

    def painter(self, kinds: tuple[Maker, ...] = ALL) -> Painter:
        return random_painter(self.rng, self.palette, kinds, _UNIT * self.rng.uniform(0.5, 1.5))

    def painters(self) -> list[Painter]:
        """One material all over, or several."""
        return [self.painter() for _ in range(self.rng.choice([1, 1, 2, 3]))]

    def turn(self, upright: float = 0.6) -> Array:
        """A random rotation, upright or not."""
        v = self.rng.normal(size=3)
        if self.rng.random() < upright:
            v[:2] = 0
        return rotation_from_vector(v * self.rng.uniform(0.2, 1.5))

    # ------------------------------------------------------------ single solids
    def solid(self, centre: Array, half: Array, rotation: Array) -> None:
        """Any solid that fills a box of that half size."""
        makers: list[Callable[[Array, Array, Array], None]] = [
            self._box, self._box, self._blob, self._turned, self._prism, self._torus, self._cone,
        ]  # fmt: skip
        makers[self.rng.integers(len(makers))](centre, half, rotation)

    def _box(self, centre: Array, half: Array, rotation: Array) -> None:
        self.parts.box(centre, half, self.painters(), rotation)

    def _blob(self, centre: Array, half: Array, rotation: Array) -> None:
        power = float(self.rng.choice([1.2, 2.0, 2.0, 3.0, 5.0]))
        bumps = float(self.rng.choice([0, 0, 0.2, 0.4]))
        self.parts.blob(centre, half, self.painters(), rotation, power, bumps)

    def _turned(self, centre: Array, half: Array, rotation: Array) -> None:
        count = int(self.rng.integers(2, 8))
        radii = self.rng.uniform(0.3, 1, count) * half[0]
        z = np.sort(self.rng.uniform(-1, 1, count))[::-1] * half[2]
        z[[0, -1]] = half[2], -half[2]
        profile = [[0, half[2]], *np.stack([radii, z], 1), [0, -half[2]]]
        squash = float(np.clip(half[1] / half[0], 0.4, 1.5))
        self.parts.lathe(centre, profile, self.painter(), rotation, 14, squash)

    def _cone(self, centre: Array, half: Array, rotation: Array) -> None:
        top = half[0] * self.rng.choice([0.0, 0.0, 0.5, 1.0])
        profile = [[0, half[2]], [top, half[2]], [half[0], -half[2]], [0, -half[2]]]
        self.parts.lathe(centre, profile, self.painter(), rotation, 14)

    def _prism(self, centre: Array, half: Array, rotation: Array) -> None:
        count = int(self.rng.integers(3, 11))
        angle = 2 * np.pi * (np.arange(count) + self.rng.uniform(0, 0.6, count)) / count
        radius = self.rng.uniform(0.5, 1, count) if self.rng.random() < 0.6 else np.ones(count)
        if self.rng.random() < 0.3:  # a star or a gear
            radius = np.where(np.arange(count) % 2, 1.0, 0.55)
        outline = np.stack([np.cos(angle), np.sin(angle)], 1) * radius[:, None] * half[:2]
        self.parts.prism(centre, outline, 2 * half[2], self.painters(), rotation)

    def _torus(self, centre: Array, half: Array, rotation: Array) -> None:
        thick = self.rng.uniform(0.15, 0.4) * half[0]
        big = half[0] - thick

        def ring(s: Array) -> Array:
            angle = 2 * np.pi * s
            local = np.stack([big * np.cos(angle), big * np.sin(angle), 0 * angle], -1)
            return np.asarray(centre + local @ rotation.T)

        self.parts.tube(ring, thick, self.painter(), free_edges=False, around=8)

    # ------------------------------------------------------------ whole plans
    def ground(self) -> None:
        """A plate under everything, often studded like a toy brick's."""
        half = self.rng.uniform(0.6, 1.1, 2)
        z, thick = self.rng.uniform(-0.75, -0.55), self.rng.uniform(0.03, 0.08)
        if self.rng.random() < 0.3:
            profile = [[0, thick], [half[0], thick], [half[0], -thick], [0, -thick]]
            self.parts.lathe([0, 0, z - thick], profile, self.painter(FLOORS), np.eye(3), 24)
            return
        self.parts.box([0, 0, z - thick], [*half, thick], [self.painter((*FLOORS, plain))],
                       np.eye(3))  # fmt: skip
        if self.rng.random() < 0.6:
            self._studs(np.array([0, 0, z]), half, self.rng.uniform(0.16, 0.24))

    def _studs(self, top: Array, half: Array, pitch: float) -> None:
        painter = self.painter((plain,))
        r, h = 0.3 * pitch, 0.22 * pitch
        counts = (2 * half / pitch).astype(int)
        for i in range(counts[0]):
            for j in range(counts[1]):
                offset = (np.array([i, j]) - (counts - 1) / 2) * pitch
                profile = [[0, h], [r, h], [r, 0]]
                self.parts.lathe(top + [*offset, 0], profile, painter, np.eye(3), 6)

    def pile(self) -> None:
        """Solids anywhere about the middle."""
        for _ in range(self.rng.integers(4, 16)):
            centre = np.clip(self.rng.normal(0, 0.38, 3), -0.75, 0.75)
            self.solid(centre, self.rng.uniform(0.1, 0.42, 3), self.turn())

    def tower(self) -> None:
        """Solids above each other: houses, chess men, lamps."""
        z, symmetric = -0.7, self.rng.random() < 0.5
        while z < self.rng.uniform(0.2, 0.8):
            half = self.rng.uniform([0.15, 0.15, 0.05], [0.55, 0.55, 0.28])
            if symmetric:
                half[1] = half[0]
            offset = np.zeros(2) if symmetric else self.rng.normal(0, 0.08, 2)
            turn = np.eye(3) if symmetric else self.turn(1.0)
            self.solid(np.array([*offset, z + half[2]]), half, turn)
            z += 2 * half[2]

    def studded(self) -> None:
        """Toy bricks upon each other."""
        pitch = self.rng.uniform(0.17, 0.26)
        for layer in range(self.rng.integers(2, 6)):
            for _ in range(self.rng.integers(1, 4)):
                count = self.rng.integers([1, 1], [5, 4])
                half = count * pitch / 2
                place = np.round(self.rng.uniform(-0.4, 0.4, 2) / pitch) * pitch
                z = -0.6 + (layer + 0.5) * 1.2 * pitch
                painter = [self.painter((plain, plain, *FURNITURE))]
                self.parts.box([*place, z], [*half, 0.6 * pitch], painter, np.eye(3))
                self._studs(np.array([*place, z + 0.6 * pitch]), half, pitch)

    def vehicle(self) -> None:
        """A body, a cabin, wheels, an arm: mirrored left and right, not front and back."""
        body = self.rng.uniform([0.45, 0.22, 0.1], [0.8, 0.4, 0.25])
        z = self.rng.uniform(-0.35, -0.2)
        self._box(np.array([0, 0, z]), body, np.eye(3))
        cabin = body * self.rng.uniform([0.25, 0.7, 0.8], [0.6, 1.0, 1.6])
        x = self.rng.uniform(-0.5, 0.5) * body[0]
        self.solid(np.array([x, 0, z + body[2] + cabin[2]]), cabin, np.eye(3))
        r, painter = self.rng.uniform(0.12, 0.24), self.painter((plain, *ALL))
        upright = rotation_from_vector([np.pi / 2, 0, 0])
        profile = [[0, 0.07], [0.5 * r, 0.06], [r, 0.06], [r, -0.06], [0, -0.06]]
        for wheel in np.linspace(-0.8, 0.8, self.rng.integers(2, 5)) * body[0]:
            for side in (-1, 1):
                place = [wheel, side * (body[1] + 0.05), z - body[2]]
                self.parts.lathe(place, profile, painter, upright, 14)
        self._arm(np.array([body[0], 0, z + body[2]]))

    def _arm(self, start: Array) -> None:
        for _ in range(self.rng.integers(1, 4)):
            step = self.rng.normal([0.1, 0, 0.2], [0.15, 0.08, 0.15])
            length = float(np.linalg.norm(step))
            axis = np.cross([0, 0, 1.0], step / length)
            angle = np.arccos(np.clip(step[2] / length, -1, 1))
            norm = max(float(np.linalg.norm(axis)), 1e-9)
            rotation = rotation_from_vector(axis / norm * angle)
            half = np.array([0.05, 0.07, length / 2])
            self.parts.box(start + step / 2, half, self.painters(), rotation)
            start = start + step
        self.solid(start, self.rng.uniform(0.08, 0.2, 3), self.turn())

    def flower(self) -> None:
        """The same solid several times about the upright axis, with one that differs."""
        count, distance = int(self.rng.integers(3, 9)), self.rng.uniform(0.3, 0.65)
        half, z = self.rng.uniform(0.08, 0.25, 3), self.rng.uniform(-0.4, 0.3)
        self.solid(np.array([0, 0, z]), self.rng.uniform(0.15, 0.4, 3), np.eye(3))
        shared = self.parts.rng.integers(2**31)
        odd = int(self.rng.integers(count))
        for index in range(count):
            angle = 2 * np.pi * index / count
            place = np.array([distance * np.cos(angle), distance * np.sin(angle), z])
            turn = rotation_from_vector([0, 0, angle])
            if index != odd:  # all alike: drawn from one seed
                self._alike(int(shared), place, half, turn)
            else:
                self.solid(place, half * 1.3, turn)

    def _alike(self, seed: int, place: Array, half: Array, turn: Array) -> None:
        own = self.rng
        self.rng = self.parts.rng = np.random.default_rng(seed)
        self.solid(place, half, turn)
        self.rng = self.parts.rng = own

    def details(self) -> None:
        """Fine structures: rods, handles, balls."""
        painters = [self.painter((plain, *FURNITURE)) for _ in range(3)]
        for _ in range(self.rng.integers(2, 14)):
            painter = painters[self.rng.integers(3)]
            a, b = self.rng.normal(0, 0.42, (2, 3)).clip(-0.8, 0.8)
            bend = self.rng.normal(0, 0.25, 3) * self.rng.integers(0, 2)

            def curve(s: Array, a: Array = a, b: Array = b, bend: Array = bend) -> Array:
                s = s[..., None]
                return np.asarray(a + s * (b - a) + 4 * s * (1 - s) * bend)

            self.parts.tube(curve, self.rng.uniform(0.015, 0.05), painter, 16, 5)
            if self.rng.random() < 0.5:
                self.parts.blob(b, np.full(3, self.rng.uniform(0.05, 0.12)), [painter], np.eye(3))

    # ------------------------------------------------------------ done
    def finished(self) -> ProceduralMap:
        low, high = np.min(self.parts.low, axis=0), np.max(self.parts.high, axis=0)
        bake(self.parts, random_lighting(self.rng, low, high))
        detail = np.where(self.rng.random(len(self.parts.patches)) < 0.1, 0.15, 1.0)
        budget = int(self.rng.uniform(*_GAUSSIANS))
        gmap = lay(self.parts.patches, budget, detail, random_finish(self.rng), self.rng)
        # a camera with 39 degrees of view sees a ball of this size whole from RADIUS
        middle = (gmap.means.min(axis=0) + gmap.means.max(axis=0)) / 2
        reach = float(np.linalg.norm(gmap.means - middle, axis=1).max())
        scale = RADIUS * np.sin(HALF_VIEW) * self.rng.uniform(0.88, 1.0) / reach
        gmap.means -= middle
        gmap.means *= np.float32(scale)
        gmap.scales *= np.float32(scale)
        return ProceduralMap(gmap, "object", (0.0, 0.0, 1.0), np.zeros(3), RADIUS)
