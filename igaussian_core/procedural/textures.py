"""Random textures: each call of `random_painter` fixes a kind, colours and sizes of a material.

A painter fills any rectangle with its material; rectangles differ, since the noise does.
"""

from __future__ import annotations

import colorsys
import string
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Image = NDArray[np.float32]
Colour = NDArray[np.float32]


@dataclass(frozen=True)
class Canvas:
    """What a painter is given: a grid of texels on a rectangle of known size in metres."""

    rows: int
    cols: int
    width: float
    height: float
    rng: np.random.Generator

    def grid(self) -> tuple[Image, Image]:
        """Texel centres in metres from the top-left corner, two arrays [rows, cols]."""
        x = (np.arange(self.cols, dtype=np.float32) + 0.5) * (self.width / self.cols)
        y = (np.arange(self.rows, dtype=np.float32) + 0.5) * (self.height / self.rows)
        gx, gy = np.meshgrid(x.astype(np.float32), y.astype(np.float32))
        return gx, gy


# canvas -> colours [rows, cols, 3] float32, about 0..1
Painter = Callable[[Canvas], Image]


@dataclass(frozen=True)
class Palette:
    """Colours [N, 3] in 0..1 that go together in one map."""

    colours: Image

    def pick(self, rng: np.random.Generator) -> Colour:
        """One of the colours, a little changed."""
        base = self.colours[rng.integers(len(self.colours))]
        changed = base * rng.uniform(0.75, 1.2) + rng.normal(0, 0.03, 3)
        return np.asarray(np.clip(changed, 0.03, 0.97), np.float32)

    def pair(self, rng: np.random.Generator) -> tuple[Colour, Colour]:
        """Two colours that can be told apart."""
        first = self.pick(rng)
        for _ in range(8):
            second = self.pick(rng)
            if np.abs(first - second).sum() > 0.45:
                return first, second
        return first, np.asarray(np.where(first.mean() > 0.5, first * 0.4, first * 0.4 + 0.6))


def random_palette(rng: np.random.Generator) -> Palette:
    """A few hues about one or two main ones, and neutral tones."""
    hue, spread = rng.random(), rng.choice([0.06, 0.2, 0.5, 0.5])
    colourful = rng.uniform(0.25, 0.9)
    colours = []
    for _ in range(rng.integers(4, 9)):
        h = (hue + rng.normal(0, spread)) % 1
        colours.append(
            colorsys.hsv_to_rgb(h, colourful * rng.uniform(0.1, 1.1), rng.uniform(0.2, 1.0))
        )
    colours += [(v, v * rng.uniform(0.92, 1), v * rng.uniform(0.85, 1))
                for v in rng.uniform(0.1, 1.0, rng.integers(2, 7))]  # fmt: skip
    return Palette(np.clip(np.array(colours, np.float32), 0, 1))


def noise(canvas: Canvas, size: float | tuple[float, float], octaves: int = 3) -> Image:
    """Smooth noise [rows, cols] of mean 0 and deviation about 1; `size` of its largest features
    in metres, along x and y."""
    sx, sy = (size, size) if isinstance(size, (int, float)) else size
    total = np.zeros((canvas.rows, canvas.cols), np.float32)
    for octave in range(octaves):
        cols = int(np.clip(canvas.width / sx * 2**octave, 1, canvas.cols)) + 2
        rows = int(np.clip(canvas.height / sy * 2**octave, 1, canvas.rows)) + 2
        coarse = canvas.rng.standard_normal((rows, cols)).astype(np.float32)
        fine = cv2.resize(coarse, (canvas.cols, canvas.rows), interpolation=cv2.INTER_CUBIC)
        total += fine * 0.6**octave
    return total


def blend(first: Image | Colour, second: Image | Colour, share: Image) -> Image:
    """first where share is 0, second where it is 1."""
    return np.asarray(first + (second - first) * np.clip(share, 0, 1)[..., None], np.float32)


def step(value: Image, edge: float, width: float) -> Image:
    """0 below the edge, 1 above, linear over `width` about it."""
    return np.clip((value - edge) / max(width, 1e-6) + 0.5, 0, 1)


def flat(canvas: Canvas, colour: Colour) -> Image:
    return np.broadcast_to(colour, (canvas.rows, canvas.cols, 3)).astype(np.float32)


def grain(canvas: Canvas, image: Image, strength: float, size: float) -> Image:
    return image + strength * noise(canvas, size, 3)[..., None]


# ---------------------------------------------------------------- kinds of materials
# each: (rng, palette, unit) -> Painter; `unit` is the length in metres that 1 m of a room's
# pattern has, less for small objects
Maker = Callable[[np.random.Generator, Palette, float], Painter]


def plain(rng: np.random.Generator, palette: Palette, unit: float) -> Painter:
    """Almost one colour."""
    colour, strength, size = palette.pick(rng), rng.uniform(0.01, 0.05), rng.uniform(0.1, 0.6)
    return lambda canvas: grain(canvas, flat(canvas, colour), strength, size * unit)


def clouds(rng: np.random.Generator, palette: Palette, unit: float) -> Painter:
    """Smooth or sharp transitions between two colours: plaster, camouflage, dirt."""
    (a, b), size = palette.pair(rng), rng.uniform(0.3, 1.2) * unit
    sharp, octaves = rng.choice([0.1, 1.0, 3.0]), int(rng.integers(1, 4))
    return lambda canvas: blend(a, b, step(noise(canvas, size, octaves), 0, sharp))


def marble(rng: np.random.Generator, palette: Palette, unit: float) -> Painter:
    (a, b), size, bands = palette.pair(rng), rng.uniform(0.3, 1.0) * unit, rng.uniform(2, 6)

    def paint(canvas: Canvas) -> Image:
        vein = np.abs(np.sin(noise(canvas, size, 4) * bands))
        return grain(canvas, blend(b, a, step(vein, 0.2, 0.4)), 0.03, size)

    return paint


def stripes(rng: np.random.Generator, palette: Palette, unit: float) -> Painter:
    period, share = rng.uniform(0.08, 0.5) * unit, rng.uniform(0.2, 0.6)
    (a, b), angle = palette.pair(rng), rng.choice([0.0, np.pi / 2, np.pi / 4, rng.uniform(0, 3)])
    wobble, c = rng.choice([0.0, 0.0, 0.15]), palette.pick(rng)

    def paint(canvas: Canvas) -> Image:
        x, y = canvas.grid()
        along = (x * np.cos(angle) + y * np.sin(angle)) / period
        phase = (along + wobble * noise(canvas, 3 * period, 2)) % 1
        image = blend(a, b, step(np.abs(phase - 0.5), 0.5 - share / 2, 0.04))
        image = blend(image, c, (np.abs(phase - 0.1) < 0.04).astype(np.float32))
        return grain(canvas, image, 0.03, 0.3 * unit)

    return paint


def checks(rng: np.random.Generator, palette: Palette, unit: float) -> Painter:
    """Chequered cloth, or a chess board."""
    (a, b), size, hard = palette.pair(rng), rng.uniform(0.06, 0.35) * unit, rng.random() < 0.5

    def paint(canvas: Canvas) -> Image:
        x, y = canvas.grid()
        i, j = (x / size).astype(int) % 2, (y / size).astype(int) % 2
        share = (i ^ j) if hard else (i + j) / 2
        return grain(canvas, blend(a, b, share.astype(np.float32)), 0.03, 0.3 * unit)

    return paint


def tiles(rng: np.random.Generator, palette: Palette, unit: float) -> Painter:
    """Tiles or bricks with joints, each of its own tone."""
    brick = rng.random() < 0.5
    size = rng.uniform(0.12, 0.5) * unit
    ratio, shift = (rng.uniform(2, 3.5), 0.5) if brick else (rng.choice([1.0, 1.0, 1.6]), 0.0)
    a, b = palette.pair(rng)
    joint, vary = palette.pick(rng), rng.uniform(0.03, 0.15)
    mixed, gap = rng.random() < 0.5, rng.uniform(0.03, 0.08)

    def paint(canvas: Canvas) -> Image:
        x, y = canvas.grid()
        row = np.floor(y / (size / ratio)).astype(int)
        along = x / size + shift * (row % 2)
        column = np.floor(along).astype(int)
        table = canvas.rng.standard_normal((row.max() + 1, column.max() + 1)).astype(np.float32)
        tone = table[row, column]
        image = blend(a, b, (tone > 0.7).astype(np.float32)) if mixed else flat(canvas, a)
        image = grain(canvas, image + vary * tone[..., None], 0.03, 0.2 * unit)
        fx, fy = np.abs(along % 1 - 0.5), np.abs((y * ratio / size) % 1 - 0.5)
        return blend(image, joint, np.maximum(step(fx, 0.5 - gap / ratio, 0.02),
                                              step(fy, 0.5 - gap, 0.04)))  # fmt: skip

    return paint


def planks(rng: np.random.Generator, palette: Palette, unit: float) -> Painter:
    """Floor boards or panelling: rows of wood, cut at random places."""
    width, length = rng.uniform(0.08, 0.3) * unit, rng.uniform(0.6, 2.0) * unit
    hue = rng.uniform(0.04, 0.11)
    wood = np.array(colorsys.hsv_to_rgb(hue, rng.uniform(0.25, 0.7), rng.uniform(0.3, 0.85)))
    if rng.random() < 0.3:
        wood = palette.pick(rng).astype(float)
    vary, upright = rng.uniform(0.05, 0.22), rng.random() < 0.5

    def paint(canvas: Canvas) -> Image:
        x, y = canvas.grid()
        if upright:
            x, y = y, x
        row = np.floor(y / width).astype(int)
        along = x / length + canvas.rng.random(row.max() + 1).astype(np.float32)[row]
        column = np.floor(along).astype(int)
        tone = canvas.rng.standard_normal((row.max() + 1, column.max() + 1))[row, column]
        size = (0.03 * unit, 0.8 * unit) if upright else (0.8 * unit, 0.03 * unit)
        fibre = noise(canvas, size, 3)
        image = wood * (1 + vary * tone + 0.07 * fibre)[..., None]
        seam = np.maximum(step(np.abs(y / width % 1 - 0.5), 0.46, 0.04),
                          step(np.abs(along % 1 - 0.5), 0.49, 0.01))  # fmt: skip
        return blend(image.astype(np.float32), (wood * 0.35).astype(np.float32), seam)

    return paint


def dots(rng: np.random.Generator, palette: Palette, unit: float) -> Painter:
    """Wallpaper or cloth with a regular motif: discs, rings, stars."""
    (a, b), c = palette.pair(rng), palette.pick(rng)
    period, size = rng.uniform(0.12, 0.5) * unit, rng.uniform(0.2, 0.4)
    petals, depth, offset = int(rng.integers(0, 7)), rng.uniform(0, 0.5), rng.choice([0.0, 0.5])

    def paint(canvas: Canvas) -> Image:
        x, y = canvas.grid()
        row = np.floor(y / period)
        u = (x / period + offset * (row % 2)) % 1 - 0.5
        v = (y / period) % 1 - 0.5
        radius = np.hypot(u, v) / (1 + depth * np.cos(petals * np.arctan2(v, u)))
        image = blend(b, a, step(radius, size, 0.08))
        image = blend(c, image, step(radius, size * 0.4, 0.08))
        return grain(canvas, image, 0.03, 0.4 * unit)

    return paint


def cells(rng: np.random.Generator, palette: Palette, unit: float) -> Painter:
    """Random cells (Voronoi): cobbles, terrazzo, patchwork."""
    tones = np.array([palette.pick(rng) for _ in range(6)])
    size, border = rng.uniform(0.1, 0.5) * unit, palette.pick(rng)
    wide = rng.choice([0.0, 0.12])

    def paint(canvas: Canvas) -> Image:
        x, y = canvas.grid()
        i, j = np.floor(x / size).astype(int), np.floor(y / size).astype(int)
        seeds = canvas.rng.random((j.max() + 3, i.max() + 3, 3)).astype(np.float32)
        near = np.full(x.shape, np.inf, np.float32)
        second, who = near.copy(), np.zeros(x.shape, np.float32)
        for dj in (-1, 0, 1):
            for di in (-1, 0, 1):
                seed = seeds[j + dj + 1, i + di + 1]
                d = np.hypot(x / size - i - di - seed[..., 0], y / size - j - dj - seed[..., 1])
                second = np.minimum(second, np.maximum(d, near))
                who = np.where(d < near, seed[..., 2], who)
                near = np.minimum(near, d)
        image = tones[(who * len(tones)).astype(int) % len(tones)]
        return blend(border, image, step(second - near, wide, 0.05)) if wide else image

    return paint


def shapes(rng: np.random.Generator, palette: Palette, unit: float) -> Painter:
    """A poster: random figures, lines and letters on a ground."""
    count, ground = int(rng.integers(4, 25)), palette.pick(rng)
    letters = rng.random() < 0.5

    def paint(canvas: Canvas) -> Image:
        image = np.ascontiguousarray(flat(canvas, ground))
        for _ in range(count):
            _figure(image, canvas.rng, palette.pick(canvas.rng))
        for _ in range(int(canvas.rng.integers(1, 5)) if letters else 0):
            _word(image, canvas.rng, palette.pick(canvas.rng))
        return grain(canvas, image, 0.02, 0.2 * unit)

    return paint


def _figure(image: Image, rng: np.random.Generator, colour: Colour) -> None:
    rows, cols = image.shape[:2]
    ink = tuple(float(c) for c in colour)
    x, y = int(rng.integers(cols)), int(rng.integers(rows))
    size = max(2, int(min(rows, cols) * rng.uniform(0.08, 0.4)))
    kind = rng.integers(4)
    if kind == 0:
        cv2.circle(image, (x, y), size // 2, ink, -1 if rng.random() < 0.6 else max(1, size // 8))
    elif kind == 1:
        cv2.rectangle(image, (x, y), (x + size, y + int(size * rng.uniform(0.3, 2))), ink, -1)
    elif kind == 2:
        corners = rng.integers(-size, size, (int(rng.integers(3, 6)), 2)) + [x, y]
        cv2.fillPoly(image, [corners.astype(np.int32)], ink)
    else:
        end = (int(rng.integers(cols)), int(rng.integers(rows)))
        cv2.line(image, (x, y), end, ink, max(1, size // 6))


def _word(image: Image, rng: np.random.Generator, colour: Colour) -> None:
    rows, cols = image.shape[:2]
    text = "".join(rng.choice(list(string.ascii_uppercase + string.digits), rng.integers(1, 7)))
    font = float(rng.uniform(0.12, 0.45)) * min(rows, cols) / 22
    place = (int(rng.integers(-2, max(1, cols // 2))), int(rng.integers(rows // 4, rows + 1)))
    drawn = np.zeros((rows, cols), np.uint8)
    cv2.putText(drawn, text, place, int(rng.integers(0, 5)), font, 255, max(1, round(font * 2)))
    image += (colour - image) * (drawn[..., None] / np.float32(255))


def painting(rng: np.random.Generator, palette: Palette, unit: float) -> Painter:
    """A picture: sky and hills, or abstract layers of noise, in a frame."""
    tones = [palette.pick(rng) for _ in range(5)]
    frame, landscape = palette.pick(rng), rng.random() < 0.5

    def paint(canvas: Canvas) -> Image:
        x, y = canvas.grid()
        image = blend(tones[0], tones[1], y / canvas.height)
        size = max(canvas.width, canvas.height)
        for index, tone in enumerate(tones[2:]):
            field = noise(canvas, size / 2, 4)
            if landscape:
                field = 0.5 * field[:1] + 6 * (y / canvas.height - 0.35 - 0.2 * index)
            image = blend(image, tone, step(field, 0.4, 0.08))
        image = grain(canvas, image, 0.05, size / 6)
        edge = np.minimum(np.minimum(x, canvas.width - x), np.minimum(y, canvas.height - y))
        return blend(frame, image, step(edge, 0.06 * min(canvas.width, canvas.height), 1e-3))

    return paint


def carpet(rng: np.random.Generator, palette: Palette, unit: float) -> Painter:
    """A woven rug: borders, lozenges, a medallion."""
    tones = [palette.pick(rng) for _ in range(4)]
    count, points = rng.uniform(3, 9), int(rng.integers(3, 9))

    def paint(canvas: Canvas) -> Image:
        x, y = canvas.grid()
        side = min(canvas.width, canvas.height)
        u, v = (x - canvas.width / 2) / side, (y - canvas.height / 2) / side
        lozenge = np.abs((u * count) % 1 - 0.5) + np.abs((v * count) % 1 - 0.5)
        image = blend(tones[0], tones[1], step(np.abs(lozenge - 0.5), 0.25, 0.08))
        star = np.hypot(u, v) * (1 + 0.2 * np.cos(points * np.arctan2(v, u)))
        image = blend(tones[2], image, step(star, 0.28, 0.02))
        image = blend(tones[3], image, step(star, 0.15, 0.02))
        edge = np.minimum(canvas.width / side / 2 - np.abs(u), canvas.height / side / 2 - np.abs(v))
        image = blend(tones[2], image, step(np.abs(edge - 0.08), 0.025, 0.01))
        image = blend(tones[3], image, step(edge, 0.03, 0.01))
        return grain(canvas, image, 0.04, 0.1 * unit)

    return paint


def books(rng: np.random.Generator, palette: Palette, unit: float) -> Painter:
    """A shelf full of book backs, with gaps and titles."""
    shelf, level = palette.pick(rng) * 0.5, rng.uniform(0.25, 0.4) * unit
    lively = Palette(np.concatenate([palette.colours, rng.random((4, 3)).astype(np.float32)]))

    def paint(canvas: Canvas) -> Image:
        image = np.ascontiguousarray(flat(canvas, shelf))
        kx, ky = canvas.cols / canvas.width, canvas.rows / canvas.height
        top = 0.03 * unit
        while top < canvas.height:
            x = 0.02 * unit
            while x < canvas.width - 0.05 * unit:
                width = canvas.rng.uniform(0.025, 0.08) * unit
                tall = level * canvas.rng.uniform(0.55, 0.92)
                colour = lively.pick(canvas.rng) * float(canvas.rng.random() < 0.93)
                _book(image, (x * kx, (top + level - tall) * ky), (width * kx, tall * ky), colour)
                x += width
            top += level + 0.03 * unit
        return grain(canvas, image, 0.02, 0.1 * unit)

    return paint


def _book(image: Image, corner: tuple[float, float], size: tuple[float, float], c: Colour) -> None:
    (x, y), (w, h) = corner, size
    left, right, top, bottom = round(x), max(round(x) + 1, round(x + w)), round(y), round(y + h)
    image[max(top, 0) : bottom, max(left, 0) : right] = c
    title = np.clip(c + (0.45 if c.mean() < 0.5 else -0.4), 0, 1)
    image[max(round(y + 0.2 * h), 0) : round(y + 0.4 * h), left + 1 : max(right - 1, left)] = title


def rings(rng: np.random.Generator, palette: Palette, unit: float) -> Painter:
    """Concentric figures about a random place: targets, clocks, wheels."""
    tones = np.array([palette.pick(rng) for _ in range(4)])
    spokes, count = int(rng.choice([0, 0, 4, 6, 12])), rng.uniform(3, 9)

    def paint(canvas: Canvas) -> Image:
        x, y = canvas.grid()
        side = max(canvas.width, canvas.height)
        u, v = x / side - 0.5, y / side - canvas.height / side / 2
        index = (np.hypot(u, v) * count * 2).astype(int)
        if spokes:
            index += (np.arctan2(v, u) * spokes / np.pi).astype(int)
        return grain(canvas, tones[index % len(tones)], 0.03, 0.2 * unit)

    return paint


def machine(rng: np.random.Generator, palette: Palette, unit: float) -> Painter:
    """A front with panels, buttons, grilles, screens and a label."""
    ground, count = palette.pick(rng), int(rng.integers(5, 16))

    def paint(canvas: Canvas) -> Image:
        image = np.ascontiguousarray(flat(canvas, ground))
        for _ in range(count):
            _panel(image, canvas.rng, palette.pick(canvas.rng))
        _word(image, canvas.rng, palette.pick(canvas.rng))
        return grain(canvas, image, 0.015, 0.3 * unit)

    return paint


def _panel(image: Image, rng: np.random.Generator, colour: Colour) -> None:
    rows, cols = image.shape[:2]
    h, w = (max(2, int(n * rng.uniform(0.06, 0.35))) for n in (rows, cols))
    y, x = int(rng.integers(max(1, rows - h))), int(rng.integers(max(1, cols - w)))
    part = image[y : y + h, x : x + w]
    if rng.random() < 0.4:
        part[:: max(2, h // 6)] = colour
    elif rng.random() < 0.5:
        part[:, :: max(2, w // 6)] = colour
    else:
        part[:] = colour
        part[:1], part[:, :1] = colour * 0.4, colour * 0.4


ALL: tuple[Maker, ...] = (
    plain, clouds, marble, stripes, checks, tiles, planks, dots, cells, shapes, painting, carpet,
    books, rings, machine,
)  # fmt: skip
WALLS: tuple[Maker, ...] = (
    plain, plain, plain, clouds, stripes, stripes, tiles, tiles, planks, dots, dots, checks, marble,
    cells,
)  # fmt: skip
FLOORS: tuple[Maker, ...] = (planks, planks, tiles, tiles, checks, cells, marble, clouds, dots)
PICTURES: tuple[Maker, ...] = (shapes, shapes, painting, painting, rings, machine)
FURNITURE: tuple[Maker, ...] = (plain, plain, planks, clouds, marble, stripes, checks, machine)


def random_painter(
    rng: np.random.Generator, palette: Palette, kinds: tuple[Maker, ...] = ALL, unit: float = 1.0
) -> Painter:
    """A material of one of the kinds, with its colours and sizes."""
    return kinds[rng.integers(len(kinds))](rng, palette, unit)
