"""Procedural paint: each painter maps a Canvas to colours [rows, cols, 3], 0..255.

Smooth noise is computed in float64 and rounded once, so that another CPU gives the same bytes.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from .lettering import text_width, write
from .surfaces import Array, Canvas, Image, Painter

Colour = tuple[int, int, int]


# ---------------------------------------------------------------- building blocks
def noise(canvas: Canvas, cell: float | tuple[float, float], octaves: int = 4) -> Array:
    """Fractal value noise [rows, cols], about -1..1; cell: size in metres (x, y)."""
    cell_x, cell_y = cell if isinstance(cell, tuple) else (cell, cell)
    total, weight = np.zeros((canvas.rows, canvas.cols)), 0.0
    for octave in range(octaves):
        amplitude = 0.55**octave
        step_x, step_y = cell_x / 2**octave, cell_y / 2**octave
        if min(step_x * canvas.cols / canvas.width, step_y * canvas.rows / canvas.height) < 0.7:
            break
        total += amplitude * _value_noise(canvas, step_x, step_y)
        weight += amplitude
    return total / max(weight, 1e-9)


def _value_noise(canvas: Canvas, step_x: float, step_y: float) -> Array:
    px, py = step_x * canvas.cols / canvas.width, step_y * canvas.rows / canvas.height
    nx, ny = int(canvas.cols / px) + 4, int(canvas.rows / py) + 4
    knots = canvas.rng.uniform(-1, 1, (ny, nx))
    size = (max(1, round(nx * px)), max(1, round(ny * py)))
    large = cv2.resize(knots, size, interpolation=cv2.INTER_CUBIC)
    oy, ox = int(1.5 * py), int(1.5 * px)
    return np.asarray(large[oy : oy + canvas.rows, ox : ox + canvas.cols], np.float64)


def flat(canvas: Canvas, colour: Colour) -> Array:
    """One colour everywhere, float64 [rows, cols, 3]."""
    return np.broadcast_to(np.array(colour, float), (canvas.rows, canvas.cols, 3)).copy()


def drawing(canvas: Canvas, colour: Colour) -> tuple[Image, float]:
    """An image to draw on with cv2, and its texels a metre."""
    return flat(canvas, colour).astype(np.uint8), canvas.cols / canvas.width


def blend(a: Array, b: Array | Colour, weight: Array) -> Array:
    """a where weight is 0, b where it is 1."""
    return a + (np.asarray(b, float) - a) * np.clip(weight, 0, 1)[..., None]


def step(value: Array, edge: float, soft: float) -> Array:
    """0 below edge, 1 above, with a ramp of width soft."""
    return np.clip((value - edge) / soft + 0.5, 0, 1)


# ---------------------------------------------------------------- walls, floor, cloth
def plaster(colour: Colour, strength: float = 3.0) -> Painter:
    """Painted plaster: faint blotches and roller marks."""

    def paint(canvas: Canvas) -> Array:
        rough = noise(canvas, 0.9, 4) * strength + noise(canvas, 0.02, 2) * strength * 0.7
        return flat(canvas, colour) + rough[..., None]

    return paint


def wallpaper(ground: Colour, figure: Colour, pitch: float = 0.32) -> Painter:
    """Leafy ogees in offset columns, worn by noise so that no two repeats are alike."""

    def paint(canvas: Canvas) -> Array:
        x, y = canvas.grid()
        warp = noise(canvas, 0.5, 3)
        column = np.floor(x / pitch)
        u = (x / pitch - column - 0.5) * 2
        v = ((y / (pitch * 1.5) + 0.5 * (column % 2)) % 1 - 0.5) * 2
        ogee = np.abs(u) - 0.75 * (0.5 + 0.5 * np.cos(np.pi * v)) + 0.03 * warp
        leaf = u * u * 6 + v * v * 2.5 + 0.25 * np.cos(5 * np.pi * v)
        line = 1 - step(np.abs(ogee), 0.07, 0.04)
        ink = np.maximum(line, (1 - step(leaf, 0.42, 0.12)) * 0.8)
        wear = 0.55 + 0.45 * noise(canvas, 0.4, 4)
        base = flat(canvas, ground) + (noise(canvas, 0.03, 2) * 4 + warp * 3)[..., None]
        return blend(base, figure, ink * wear)

    return paint


def planks(
    tones: tuple[Colour, ...], width: float = 0.13, length: float = 1.15, along_x: bool = True
) -> Painter:
    """Floorboards: each with its own tone, offset and grain, dark joints between."""

    def paint(canvas: Canvas) -> Array:
        x, y = canvas.grid()
        if not along_x:
            x, y = y, x
        row = np.floor(y / width).astype(int)
        shift = canvas.rng.uniform(0, length, row.max() + 1)
        column = np.floor((x + shift[row]) / length).astype(int)
        count = column.max() + 1
        board = row * count + column
        tone = canvas.rng.uniform(-1, 1, (row.max() + 1) * count)
        choice = canvas.rng.integers(0, len(tones), tone.size)
        stretch = (0.5, 0.018) if along_x else (0.018, 0.5)
        # each board takes its grain from elsewhere: no line runs on across a joint
        fibre = _shuffled(noise(canvas, stretch, 4), board, canvas.rng)
        wide = (2.2 * stretch[0], 2.2 * stretch[1])
        rings = _shuffled(noise(canvas, wide, 2), board, canvas.rng)
        grain = fibre * 15 - step(np.abs(np.sin(rings * 14)), 0.93, 0.1) * 14
        colour = np.array(tones, float)[choice[board]] + (tone[board] * 13 + grain)[..., None]
        gap = np.minimum(y % width, (x + shift[row]) % length)
        return blend(colour, (52, 36, 24), (1 - step(gap, 0.003, 0.003)) * 0.75)

    return paint


def _shuffled(field: Array, board: NDArray[np.int64], rng: np.random.Generator) -> Array:
    rows, cols = field.shape
    offset = rng.integers(0, rows * cols, board.max() + 1)[board]
    r, c = np.indices(field.shape)
    return field[(r + offset // cols) % rows, (c + offset % cols) % cols]


def wood(colour: Colour, grain: float = 14.0, along_x: bool = True) -> Painter:
    """One piece of wood."""

    def paint(canvas: Canvas) -> Array:
        stretch = (0.6, 0.02) if along_x else (0.02, 0.6)
        fibre = noise(canvas, stretch, 4)
        rings = noise(canvas, (3 * stretch[0], 3 * stretch[1]), 2)
        lines = step(np.sin(rings * 18), 0.85, 0.3)
        return flat(canvas, colour) + (fibre * grain - lines * grain * 0.8)[..., None]

    return paint


def tiles(light: Colour, dark: Colour, size: float = 0.2) -> Painter:
    """Chequered stone tiles, each a little different, grey grout."""

    def paint(canvas: Canvas) -> Array:
        x, y = canvas.grid()
        i, j = np.floor(x / size).astype(int), np.floor(y / size).astype(int)
        tone = canvas.rng.uniform(-10, 10, (j.max() + 1, i.max() + 1))[j, i]
        colour = np.where(((i + j) % 2 == 0)[..., None], np.array(light), np.array(dark))
        vein = step(np.abs(noise(canvas, 0.25, 4)), 0.05, 0.06)
        colour = colour + (tone + noise(canvas, 0.05, 3) * 8 - (1 - vein) * 14)[..., None]
        gap = np.minimum(np.minimum(x % size, size - x % size), (y % size))
        return blend(colour, (120, 116, 110), 1 - step(gap, 0.003, 0.003))

    return paint


def rug(ground: Colour, second: Colour, third: Colour) -> Painter:
    """A woven rug: fringed border, rows of lozenges, a medallion."""

    def paint(canvas: Canvas) -> Array:
        x, y = canvas.grid()
        edge = np.minimum(
            np.minimum(x, canvas.width - x), np.minimum(y, canvas.height - y)
        ) + 0.004 * noise(canvas, 0.05, 2)
        colour = flat(canvas, ground)
        lozenge = np.abs((x / 0.22) % 1 - 0.5) + np.abs((y / 0.28) % 1 - 0.5)
        colour = blend(colour, second, 1 - step(np.abs(lozenge - 0.33), 0.07, 0.05))
        colour = blend(colour, third, 1 - step(lozenge, 0.13, 0.05))
        u, v = (x - canvas.width / 2) / 0.55, (y - canvas.height / 2) / 0.38
        star = np.abs(u) + np.abs(v) + 0.12 * np.cos(4 * np.arctan2(v, u) * 2)
        for radius, tint in ((1.0, second), (0.86, third), (0.62, ground), (0.34, second)):
            colour = blend(colour, tint, 1 - step(star, radius, 0.03))
        zigzag = np.abs(((x + y) / 0.09) % 1 - 0.5) * 2
        band = (1 - step(edge, 0.17, 0.006)) * step(edge, 0.05, 0.006)
        colour = blend(colour, np.where((zigzag > 0.5)[..., None], third, second), band)
        colour = blend(colour, ground, 1 - step(np.abs(edge - 0.11), 0.016, 0.004))
        colour = blend(colour, (214, 200, 170), 1 - step(edge, 0.05, 0.006))
        weave = noise(canvas, 0.012, 2) * 12 + noise(canvas, 0.4, 3) * 8
        return colour + weave[..., None]

    return paint


def fabric(colour: Colour, second: Colour | None = None, stripe: float = 0.0) -> Painter:
    """Upholstery: a coarse weave, optional stripes."""

    def paint(canvas: Canvas) -> Array:
        x, _ = canvas.grid()
        base = flat(canvas, colour)
        if second is not None and stripe > 0:
            base = blend(base, second, step(np.abs((x / stripe) % 1 - 0.5), 0.32, 0.05))
        weave = noise(canvas, 0.014, 2) * 12 + noise(canvas, 0.22, 3) * 10
        return base + weave[..., None]

    return paint


def curtain(colour: Colour) -> Painter:
    """Folds of cloth, drawn as light and dark."""

    def paint(canvas: Canvas) -> Array:
        x, _ = canvas.grid()
        sway = noise(canvas, (0.12, 1.5), 2)
        folds = np.sin(2 * np.pi * x / 0.085 + 2.5 * sway)
        thread = noise(canvas, (0.012, 0.05), 2) * 6
        return flat(canvas, colour) + (folds * 26 + thread)[..., None]

    return paint


def plain(colour: Colour, strength: float = 4.0) -> Painter:
    """Lacquer, plastic or metal: almost one colour."""

    def paint(canvas: Canvas) -> Array:
        return flat(canvas, colour) + (noise(canvas, 0.15, 4) * strength)[..., None]

    return paint


# ---------------------------------------------------------------- fittings
def door(colour: Colour = (226, 219, 204)) -> Painter:
    """A panelled door with a handle and a frame."""

    def paint(canvas: Canvas) -> Array:
        image, k = drawing(canvas, colour)
        w, h = canvas.cols, canvas.rows
        edge = round(0.07 * k)
        cv2.rectangle(image, (0, 0), (w - 1, h - 1), (188, 178, 158), 2 * edge)
        for top, bottom in ((0.10, 0.36), (0.42, 0.60), (0.66, 0.93)):
            for left, right in ((0.17, 0.46), (0.54, 0.83)):
                a = (round(left * w), round(top * h))
                b = (round(right * w), round(bottom * h))
                cv2.rectangle(image, a, b, (212, 204, 188), -1)
                cv2.rectangle(image, a, b, (150, 140, 122), 3)
        cv2.line(image, (edge, edge), (edge, h), (120, 110, 96), 3)
        handle = (round(0.86 * w), round(0.52 * h))
        cv2.rectangle(
            image,
            (handle[0] - 8, handle[1] - 30),
            (handle[0] + 8, handle[1] + 36),
            (170, 168, 160),
            -1,
        )
        cv2.line(image, handle, (handle[0] - 42, handle[1]), (110, 108, 104), 10)
        return image + (noise(canvas, (0.03, 0.5), 3) * 5)[..., None]

    return paint


def outside(canvas: Canvas) -> Array:
    """A window: bright sky, hills and trees, behind a white frame with a cross bar."""
    x, y = canvas.grid()
    sky = flat(canvas, (226, 238, 252)) - (y / canvas.height * 10)[..., None]
    colour = blend(sky, (252, 252, 252), step(noise(canvas, (0.5, 0.2), 5), 0.12, 0.4))
    for level, height, tint in ((0.55, 0.12, (176, 196, 190)), (0.68, 0.08, (150, 178, 140))):
        ridge = canvas.height * level - height * noise(canvas, (0.5, 9.0), 4)
        colour = blend(colour, tint, step(y - ridge, 0, 0.01))
    leaves = noise(canvas, 0.12, 5)
    crown = (x - 0.32 * canvas.width) ** 2 + (y - 0.6 * canvas.height) ** 2
    tree = step(0.13 + 0.1 * leaves - crown * 1.1, 0.05, 0.02)
    colour = blend(colour, (118, 146, 96), tree * (0.7 + 0.3 * leaves))
    frame = np.minimum(np.minimum(x, canvas.width - x), np.minimum(y, canvas.height - y))
    bars = np.minimum(frame - 0.06, np.abs(x - canvas.width / 2) - 0.03)
    bars = np.minimum(bars, np.abs(y - canvas.height * 0.3) - 0.018)
    white = blend(flat(canvas, (205, 205, 200)), (150, 150, 146), 1 - step(-bars, 0.006, 0.004))
    return blend(colour, white, 1 - step(bars, 0, 0.004))


def radiator(canvas: Canvas) -> Array:
    """White ribs."""
    x, y = canvas.grid()
    rib = np.abs((x / 0.06) % 1 - 0.5) * 2
    shade = flat(canvas, (232, 230, 224)) - (step(rib, 0.8, 0.2) * 95)[..., None]
    ends = step(np.minimum(y, canvas.height - y), 0.035, 0.01)
    return shade - ((1 - ends) * 24)[..., None]


def lamp(colour: Colour) -> Painter:
    """A glowing shade, brighter in its middle."""

    def paint(canvas: Canvas) -> Array:
        _, y = canvas.grid()
        glow = 1 - (2 * y / canvas.height - 1) ** 2
        return flat(canvas, colour) + (glow * 12 - 10 + noise(canvas, 0.05, 2) * 2)[..., None]

    return paint


def clock(canvas: Canvas) -> Array:
    """A round clock face."""
    image, k = drawing(canvas, (236, 232, 222))
    c, r = (canvas.cols // 2, canvas.rows // 2), canvas.cols // 2
    cv2.circle(image, c, r - 2, (40, 44, 52), -1, cv2.LINE_AA)
    cv2.circle(image, c, round(r * 0.87), (248, 246, 240), -1, cv2.LINE_AA)
    for hour in range(12):
        ray = np.array([np.sin(hour * np.pi / 6), -np.cos(hour * np.pi / 6)])
        a, b = np.rint(c + ray * r * 0.66).astype(int), np.rint(c + ray * r * 0.8).astype(int)
        cv2.line(image, tuple(map(int, a)), tuple(map(int, b)), (30, 30, 34), 4, cv2.LINE_AA)
    cv2.line(image, c, (c[0] + round(r * 0.4), c[1] - round(r * 0.2)), (20, 20, 24), 6)
    cv2.line(image, c, (c[0] - round(r * 0.2), c[1] - round(r * 0.6)), (20, 20, 24), 4)
    return image.astype(float)


def disc(canvas: Canvas) -> NDArray[np.bool_]:
    """Mask of the inscribed ellipse."""
    x, y = canvas.grid()
    u, v = 2 * x / canvas.width - 1, 2 * y / canvas.height - 1
    return np.asarray(u * u + v * v <= 1)


def leaf_shape(canvas: Canvas) -> NDArray[np.bool_]:
    """Mask of a pointed leaf whose stalk is below."""
    x, y = canvas.grid()
    u, v = np.abs(2 * x / canvas.width - 1), 1 - y / canvas.height
    return np.asarray(u <= 3.2 * np.sqrt(v) * (1 - v) ** 0.8 / 1.3)


def leaf(colour: Colour) -> Painter:
    """A leaf: midrib and veins."""

    def paint(canvas: Canvas) -> Array:
        x, y = canvas.grid()
        u, v = 2 * x / canvas.width - 1, y / canvas.height
        vein = 1 - step(np.abs(((v + 0.35 * np.abs(u)) * 9) % 1 - 0.5), 0.1, 0.12)
        rib = 1 - step(np.abs(u), 0.07, 0.06)
        base = flat(canvas, colour) + (noise(canvas, 0.06, 3) * 16)[..., None]
        return blend(base, (168, 190, 120), np.maximum(vein * 0.4, rib * 0.8))

    return paint


# ---------------------------------------------------------------- posters and things
def framed(inner: Painter, colour: Colour, frame: float = 0.03, mount: float = 0.0) -> Painter:
    """A picture with a frame and, where mount > 0 (metres), a white mount."""

    def paint(canvas: Canvas) -> Array:
        x, y = canvas.grid()
        edge = np.minimum(np.minimum(x, canvas.width - x), np.minimum(y, canvas.height - y))
        result = np.asarray(inner(canvas), float)
        result = blend(result, (244, 241, 232), 1 - step(edge, frame + mount, 0.003))
        wood_like = flat(canvas, colour) + (noise(canvas, 0.05, 3) * 8)[..., None]
        bevel = step(np.abs(edge - frame * 0.5), frame * 0.35, 0.004) * 22
        return blend(result, wood_like - bevel[..., None], 1 - step(edge, frame, 0.002))

    return paint


def landscape(sky: Colour, far: Colour, near: Colour, sun: bool = True) -> Painter:
    """Fractal ridges fading into the distance above a lake."""

    def paint(canvas: Canvas) -> Array:
        x, y = canvas.grid()
        w, h = canvas.width, canvas.height
        colour = flat(canvas, sky) + ((y / h - 0.3) * 60)[..., None]
        colour = colour + (noise(canvas, (0.5, 0.12), 5) * 22)[..., None]
        if sun:
            far_off = np.sqrt((x - 0.68 * w) ** 2 + (y - 0.26 * h) ** 2)
            colour = blend(colour, (255, 236, 190), 1 - step(far_off, 0.085 * w, 0.006))
        for i in range(5):
            f = i / 4
            ridge = h * (0.36 + 0.1 * i) - h * (0.15 - 0.02 * i) * noise(canvas, (w / 2.5, 99), 6)
            tint = np.array(far) * (1 - f) + np.array(near) * f
            rock = noise(canvas, (0.1, 0.05), 5) * 34
            slope = np.clip(tint + (rock * (0.5 + f))[..., None], 0, 255)
            colour = colour + (slope - colour) * step(y - ridge, 0, 0.004)[..., None]
        shore = step(y, 0.86 * h, 0.004)
        water = np.array(sky) * 0.75 + (noise(canvas, (0.3, 0.01), 4) * 40)[..., None]
        return colour + (water - colour) * shore[..., None]

    return paint


def shapes(ground: Colour, palette: tuple[Colour, ...], title: str) -> Painter:
    """An abstract exhibition poster: discs, bars, triangles, lettering."""

    def paint(canvas: Canvas) -> Array:
        image, _ = drawing(canvas, ground)
        w, h = canvas.cols, canvas.rows
        rng = canvas.rng
        for i in range(26):
            colour = palette[i % len(palette)]
            c = (int(rng.integers(0, w)), int(rng.integers(0, round(0.8 * h))))
            r = int(rng.integers(w // 22, w // 5))
            kind = i % 4
            if kind == 0:
                cv2.circle(image, c, r, colour, -1, cv2.LINE_AA)
            elif kind == 1:
                cv2.circle(image, c, r, colour, max(2, r // 5), cv2.LINE_AA)
            elif kind == 2:
                points = np.array(c) + rng.integers(-r, r + 1, (3, 2))
                cv2.fillPoly(image, [points.astype(np.int32)], colour, cv2.LINE_AA)
            else:
                end = (c[0] + int(rng.integers(-2 * r, 2 * r)), c[1] + r)
                cv2.line(image, c, end, colour, max(3, r // 4), cv2.LINE_AA)
        size = 0.86 * w / (text_width(title, 6) / 6)
        write(image, title, 0.07 * w, 0.94 * h - size, size, palette[0], 0.18)
        return image + (noise(canvas, 0.02, 2) * 4)[..., None]

    return paint


def printed(ground: Colour, ink: Colour, lines: tuple[str, ...], accent: Colour) -> Painter:
    """A typographic poster: big lines, then columns of small print."""

    def paint(canvas: Canvas) -> Array:
        image, k = drawing(canvas, ground)
        w, h = canvas.cols, canvas.rows
        y = 0.07 * h
        for i, line in enumerate(lines):
            size = min(0.8 * w / (text_width(line, 6) / 6), 0.2 * h)
            write(image, line, 0.09 * w, y, size, accent if i == 1 else ink, 0.19)
            y += size * 1.45
        cv2.line(image, (round(0.09 * w), round(y)), (round(0.91 * w), round(y)), accent, 6)
        _small_print(canvas, image, y + 0.03 * h, 0.02 * k, ink)
        return image + (noise(canvas, 0.02, 2) * 4)[..., None]

    return paint


def _small_print(canvas: Canvas, image: Image, y: float, size: float, ink: Colour) -> None:
    """Two columns of made-up words down to the foot of the sheet."""
    letters = "ETAOINSHRDLUCMFWYPVBGKQJXZ"
    w, h = canvas.cols, canvas.rows
    while y + size < 0.95 * h:
        for left in (0.09, 0.53):
            x = left * w
            while x < (left + 0.36) * w:
                count = int(canvas.rng.integers(2, 8))
                picks = canvas.rng.integers(0, 14, count)
                word = "".join(letters[int(i)] for i in picks)
                write(image, word, x, y, size, ink, 0.14)
                x += text_width(word, size) + 1.2 * size
        y += 1.9 * size


def contours(ground: Colour, line: Colour, water: Colour) -> Painter:
    """A map: height lines, a lake, a grid, a road."""

    def paint(canvas: Canvas) -> Array:
        x, y = canvas.grid()
        height = noise(canvas, 0.42, 4)
        band = np.abs((height * 9) % 1 - 0.5) * 2
        colour = flat(canvas, ground) + (np.floor(height * 9) * 7)[..., None]
        colour = blend(colour, line, step(band, 0.84, 0.12))
        colour = blend(colour, water, 1 - step(height, -0.32, 0.02))
        road = np.abs(y - canvas.height * 0.6 - 0.12 * np.sin(x * 7) - 0.05 * np.sin(x * 17))
        colour = blend(colour, (196, 60, 40), 1 - step(road, 0.006, 0.003))
        lines = np.minimum(x % 0.12, y % 0.12)
        return blend(colour, (90, 110, 150), (1 - step(lines, 0.002, 0.002)) * 0.5)

    return paint


def patches(palette: tuple[Colour, ...], cell: float = 0.09) -> Painter:
    """A colour study: a quilt of uneven rectangles."""

    def paint(canvas: Canvas) -> Array:
        image, k = drawing(canvas, palette[0])
        y = 0
        while y < canvas.rows:
            height, x = int(canvas.rng.uniform(0.4, 1.4) * cell * k), 0
            while x < canvas.cols:
                width = int(canvas.rng.uniform(0.4, 1.8) * cell * k)
                colour = palette[int(canvas.rng.integers(0, len(palette)))]
                cv2.rectangle(image, (x, y), (x + width, y + height), colour, -1)
                x += width
            y += height
        return image + (noise(canvas, 0.05, 4) * 12)[..., None]

    return paint


def whiteboard(canvas: Canvas) -> Array:
    """Sketches and notes in pen: a block diagram, a curve, words."""
    image, k = drawing(canvas, (240, 242, 242))
    w, h, rng = canvas.cols, canvas.rows, canvas.rng
    pens: tuple[Colour, ...] = ((30, 50, 140), (170, 40, 40), (30, 110, 60), (30, 30, 36))
    names = ("CAMERA", "COARSE", "RENDER", "MATCH", "POSE")
    for i, name in enumerate(names):
        x, y = 0.05 * w + (i % 3) * 0.2 * w, 0.1 * h + (i // 3) * 0.24 * h
        box = (round(x), round(y)), (round(x + 0.155 * w), round(y + 0.13 * h))
        cv2.rectangle(image, *box, pens[i % 4], 3, cv2.LINE_AA)
        write(image, name, x + 0.012 * w, y + 0.05 * h, 0.035 * h, pens[3], 0.14)
        tip = (round(x + 0.2 * w), round(y + 0.065 * h))
        cv2.arrowedLine(image, (round(x + 0.16 * w), tip[1]), tip, pens[3], 3, cv2.LINE_AA)
    t = np.linspace(0, 1, 120)
    curve = np.stack([(0.66 + 0.28 * t) * w, (0.42 - 0.3 * t * t + 0.03 * np.sin(25 * t)) * h], 1)
    cv2.polylines(image, [np.rint(curve).astype(np.int32)], False, pens[1], 4, cv2.LINE_AA)
    axes = np.array([[0.65, 0.08], [0.65, 0.46], [0.95, 0.46]]) * [w, h]
    cv2.polylines(image, [np.rint(axes).astype(np.int32)], False, pens[3], 3, cv2.LINE_AA)
    for i, words in enumerate(("X MAP - R X CAM", "TODO 1 CALIBRATE", "2 DRIVE 3 LOOK", "BUY TEA")):
        write(image, words, 0.06 * w, (0.62 + 0.085 * i) * h, 0.05 * h, pens[i % 4], 0.12)
    for _ in range(9):
        c = (round(rng.uniform(0.62, 0.94) * w), round(rng.uniform(0.58, 0.9) * h))
        cv2.circle(image, c, round(rng.uniform(0.01, 0.035) * w), pens[int(rng.integers(4))], 3)
    return image + (noise(canvas, 0.3, 4) * 3)[..., None]


def spines(canvas: Canvas) -> Array:
    """A row of book spines as seen from the front."""
    image, k = drawing(canvas, (60, 50, 44))
    rng, x, h = canvas.rng, 0, canvas.rows
    while x < canvas.cols:
        width = max(6, round(float(rng.uniform(0.018, 0.05)) * k))
        hue = rng.uniform(0, 1, 3) * [150, 105, 90] + rng.uniform(20, 90)
        tint = (int(hue[0]), int(hue[1]), int(hue[2]))
        cv2.rectangle(image, (x, 0), (x + width - 2, h), tint, -1)
        gilt = (235, 215, 150) if sum(tint) < 330 else (40, 34, 40)
        for level in rng.uniform(0.06, 0.94, int(rng.integers(1, 4))):
            y = round(float(level) * h)
            cv2.line(image, (x + 1, y), (x + width - 3, y), gilt, int(rng.integers(2, 5)))
        if rng.uniform() < 0.6:
            top, foot = round(0.3 * h), round(float(rng.uniform(0.5, 0.8)) * h)
            cv2.rectangle(image, (x + width // 4, top), (x + 3 * width // 4, foot), gilt, -1)
            for y in range(top + 4, foot - 4, 9):
                cv2.line(image, (x + width // 3, y), (x + 2 * width // 3, y), tint, 3)
        cv2.line(image, (x + width - 1, 0), (x + width - 1, h), (24, 20, 18), 2)
        x += width
    return image + (noise(canvas, 0.06, 4) * 10)[..., None]


def cardboard(label: str) -> Painter:
    """A brown box with tape, a label and an arrow."""

    def paint(canvas: Canvas) -> Array:
        image, k = drawing(canvas, (178, 140, 96))
        w, h = canvas.cols, canvas.rows
        cv2.rectangle(
            image, (round(0.44 * w), 0), (round(0.56 * w), round(0.3 * h)), (206, 176, 128), -1
        )
        size = min(0.16 * h, 0.7 * w / (text_width(label, 6) / 6))
        write(image, label, 0.1 * w, 0.42 * h, size, (60, 40, 26), 0.17)
        cv2.rectangle(
            image,
            (round(0.1 * w), round(0.66 * h)),
            (round(0.5 * w), round(0.92 * h)),
            (236, 234, 226),
            -1,
        )
        for i in range(5):
            y = round((0.7 + 0.045 * i) * h)
            cv2.line(image, (round(0.13 * w), y), (round((0.3 + 0.03 * i) * w), y), (50, 50, 54), 3)
        base = (round(0.75 * w), round(0.92 * h))
        cv2.arrowedLine(image, base, (base[0], round(0.68 * h)), (60, 40, 26), 5, tipLength=0.4)
        return image + (noise(canvas, (0.3, 0.03), 4) * 9)[..., None]

    return paint


def screen(canvas: Canvas) -> Array:
    """A monitor: an editor of coloured words beside a plot."""
    image, k = drawing(canvas, (28, 31, 38))
    w, h, rng = canvas.cols, canvas.rows, canvas.rng
    inks: tuple[Colour, ...] = ((126, 186, 230), (222, 150, 90), (150, 200, 130), (210, 210, 214))
    for row in range(16):
        x, y = 0.04 * w + 0.03 * w * int(rng.integers(0, 4)), (0.08 + 0.055 * row) * h
        for _ in range(int(rng.integers(2, 6))):
            length = float(rng.uniform(0.02, 0.1)) * w
            ink = inks[int(rng.integers(4))]
            a, b = (round(x), round(y)), (round(min(x + length, 0.56 * w)), round(y + 0.022 * h))
            cv2.rectangle(image, a, b, ink, -1)
            x += length + 0.012 * w
    plot = (round(0.62 * w), round(0.1 * h)), (round(0.96 * w), round(0.55 * h))
    cv2.rectangle(image, *plot, (238, 238, 240), -1)
    t = np.linspace(0, 1, 50)
    for i, ink in enumerate(inks[:3]):
        y_curve = 0.45 - 0.25 * t ** (0.5 + i) - 0.03 * np.sin(20 * t + i)
        curve = np.stack([(0.64 + 0.3 * t) * w, y_curve * h + 0.05 * h], 1)
        cv2.polylines(image, [np.rint(curve).astype(np.int32)], False, ink, 4, cv2.LINE_AA)
    cv2.rectangle(image, (0, 0), (w - 1, h - 1), (14, 14, 16), round(0.03 * k))
    return image.astype(float)
