"""The furnished room: walls, fittings and furniture, before the light is baked in.

Metres, `map` frame: x east, y north, z up, origin in the south-west corner of the floor.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from . import textures as tx
from .surfaces import Array, Canvas, Painter, Room, Solid

WIDTH, DEPTH, HEIGHT = 6.4, 5.0, 2.6
OAK, WALNUT, WHITE = (176, 130, 82), (104, 70, 46), (236, 234, 228)
WINDOW_LIGHT, PANEL_LIGHT, SHADE_LIGHT = (5.5, 6.2, 7.2), (30.0, 28.0, 24.5), (6.0, 4.6, 2.8)


def build_room() -> Room:
    """The whole room with albedo textures."""
    room = Room(WIDTH, DEPTH, HEIGHT)
    _shell(room)
    _north_side(room)
    _east_side(room)
    _south_side(room)
    _west_side(room)
    _middle(room)
    return room


def _shell(room: Room) -> None:
    w, d, h = WIDTH, DEPTH, HEIGHT
    x, y, z = np.eye(3)
    shell: dict[str, Any] = {"free_edges": False}
    room.rectangle("floor", y * d, x * w, -y * d, _floor, 0.0033, importance=0.5, **shell)
    ceiling = tx.plaster((238, 237, 232), 2.0)
    room.rectangle("ceiling", z * h, x * w, y * d, ceiling, 0.006, importance=0.3, **shell)
    paper = tx.wallpaper((206, 199, 178), (150, 158, 132))
    room.rectangle("north", y * d + z * h, x * w, -z * h, paper, importance=1.2, **shell)
    east = tx.plaster((176, 198, 196), 4.0)
    room.rectangle("east", x * w + y * d + z * h, -y * d, -z * h, east, importance=0.8, **shell)
    white = tx.plaster((232, 230, 222), 2.5)
    room.rectangle("south", x * w + z * h, -x * w, -z * h, white, importance=0.8, **shell)
    warm = tx.plaster((222, 204, 176), 4.0)
    room.rectangle("west", z * h, y * d, -z * h, warm, importance=0.8, **shell)
    skirt = tx.plain((222, 218, 208), 3)
    for wall, at, length in (("north", w / 2, w), ("south", w / 2, w), ("east", d / 2, d)):
        _panel(room, wall, f"skirting {wall}", at, 0.0, length, 0.07, skirt, thick=0.012)
    _panel(room, "west", "skirting west a", 0.22, 0.0, 0.44, 0.07, skirt, thick=0.012)
    _panel(room, "west", "skirting west b", 3.18, 0.0, 3.64, 0.07, skirt, thick=0.012)
    glow = tx.plain((255, 253, 246), 1)
    for name, along in (("west", 1.2), ("east", 4.0)):
        lamp = np.array([along, 2.2, h - 0.02])
        room.rectangle(f"lamp {name}", lamp, x * 0.6, y * 0.6, glow, 0.01, emission=PANEL_LIGHT)
        half = np.array([0.3, 0.3, 0.01])
        room.solids.append(Solid(lamp + half, np.eye(3), half))


def _floor(canvas: Canvas) -> Array:
    """Oak boards, and stone tiles inside the door."""
    boards = tx.planks((OAK, (160, 116, 74), (188, 144, 98)))(canvas)
    stone = tx.tiles((214, 208, 194), (104, 108, 112))(canvas)
    x, y = canvas.grid()
    tiled = (x < 1.4) & (y > DEPTH - 1.8)
    rail = (x < 1.43) & (y > DEPTH - 1.83) & ~tiled
    return np.where(rail[..., None], [150, 140, 120], np.where(tiled[..., None], stone, boards))


def _panel(
    room: Room,
    wall: str,
    name: str,
    along: float,
    bottom: float,
    width: float,
    height: float,
    paint: Painter,
    thick: float = 0.012,
    texel: float = 0.003,
    **options: Any,
) -> None:
    """Something flat on a wall: `along` is its middle on the wall's x or y axis."""
    x, y, z = np.eye(3)
    top = z * (bottom + height)
    places = {
        "north": (x * (along - width / 2) + y * (DEPTH - thick), x),
        "south": (x * (along + width / 2) + y * thick, -x),
        "east": (x * (WIDTH - thick) + y * (along + width / 2), -y),
        "west": (x * thick + y * (along - width / 2), y),
    }
    corner, right = places[wall]
    room.rectangle(name, corner + top, right * width, -z * height, paint, texel, **options)
    surface = room.surfaces[-1]
    centre = surface.points(np.array(0.5), np.array(0.5)) - surface.normal * thick / 2
    axes = np.array([right, surface.normal, z])
    half = np.array([width, thick, height]) / 2
    room.solids.append(Solid(centre, axes, half, opaque=surface.mask is None))


# ---------------------------------------------------------------- along the walls
def _north_side(room: Room) -> None:
    _bookshelf(room)
    doors: dict[str, Painter] = {"front": _cupboard_front, "other": tx.wood(WALNUT, 12)}
    room.box("sideboard", (3.75, 4.77, 0.06), (1.6, 0.44, 0.7), doors, "front left right top")
    room.box("plinth", (3.75, 4.8, 0.0), (1.5, 0.38, 0.06), tx.plain((40, 34, 30)), "front")
    lake = tx.landscape((196, 206, 214), (150, 168, 190), (44, 66, 58))
    framed = tx.framed(lake, (92, 66, 40), 0.035)
    _panel(room, "north", "lake", 3.75, 1.15, 1.2, 0.8, framed, 0.02, 0.0022)
    palette = ((34, 48, 90), (216, 84, 52), (240, 190, 70), (70, 140, 140), (30, 30, 34))
    art = tx.framed(tx.shapes((242, 236, 220), palette, "BAUKASTEN"), (30, 30, 32), 0.02)
    _panel(room, "north", "shapes", 5.2, 0.95, 0.66, 0.92, art, 0.015, 0.0022, importance=2.0)
    study = tx.patches(((60, 80, 110), (196, 92, 60), (226, 200, 150), (110, 130, 90)))
    _panel(room, "north", "study", 0.5, 1.1, 0.5, 0.66, tx.framed(study, WALNUT, 0.02, 0.05), 0.015)
    vase = tx.plain((58, 96, 128), 10)
    room.prism("vase", (3.15, 4.76, 0.76), 0.06, 0.2, vase, 10, 0.085)
    _leaves(room, "sprig", (3.15, 4.76, 0.93), 9, 0.24, 0.05, (104, 132, 66), 0.9)
    photo = tx.framed(tx.landscape((240, 200, 150), (200, 140, 110), (70, 50, 60)), WHITE, 0.015)
    faces: dict[str, Painter] = {"front": photo, "other": tx.plain(WHITE)}
    room.box("photo", (4.28, 4.72, 0.76), (0.26, 0.03, 0.2), faces, yaw=-14, texel=0.002)
    _books(room, "sideboard books", (3.72, 4.8, 0.76), 0.4, 0.17, 0.22)
    label: dict[str, Painter] = {
        "front": tx.cardboard("FRAGILE"),
        "top": tx.cardboard("TOP"),
        "other": tx.cardboard("LENSES"),
    }
    room.box(
        "carton a",
        (5.05, 4.68, 0.0),
        (0.5, 0.42, 0.36),
        label,
        "front left right top",
        8,
        importance=1.5,
    )
    room.box(
        "carton b",
        (5.02, 4.7, 0.36),
        (0.34, 0.3, 0.24),
        label,
        "front left right top",
        -12,
        importance=1.5,
    )
    room.prism("pot", (5.95, 4.5, 0.0), 0.15, 0.34, tx.plain((176, 96, 64), 14), 12, 0.2)
    soil = np.array([5.81, 4.64, 0.31])
    room.rectangle(
        "soil",
        soil,
        np.array([0.28, 0, 0]),
        np.array([0, -0.28, 0]),
        tx.fabric((52, 40, 30)),
        mask=tx.disc,
    )
    _leaves(room, "plant", (5.95, 4.5, 0.34), 34, 0.62, 0.12, (70, 112, 58), 0.85)


def _cupboard_front(canvas: Canvas) -> Array:
    """Three doors with knobs."""
    colour = tx.wood(WALNUT, 16, along_x=False)(canvas)
    x, y = canvas.grid()
    third = canvas.width / 3
    u = x % third
    gap = np.minimum(np.minimum(u, third - u), np.minimum(y, canvas.height - y))
    colour = tx.blend(colour, (30, 20, 14), 1 - tx.step(np.abs(gap - 0.012), 0.004, 0.002))
    knob = (u - 0.85 * third) ** 2 + (y - 0.4 * canvas.height) ** 2
    return tx.blend(colour, (206, 178, 112), 1 - tx.step(knob, 0.00025, 0.0001))


def _bookshelf(room: Room) -> None:
    """An open shelf against the north wall, x 1.05..2.35, 2 m high."""
    left, right, front, depth = 1.05, 2.35, DEPTH - 0.3, 0.3
    middle, y = (left + right) / 2, front + depth / 2
    oak = tx.wood(OAK, 16)
    back = np.array([left, DEPTH - 0.015, 2.0])
    room.rectangle(
        "shelf back",
        back,
        np.array([right - left, 0, 0]),
        np.array([0, 0, -2.0]),
        tx.wood((146, 106, 66), 10),
        0.004,
    )
    room.solids.append(
        Solid(
            np.array([middle, DEPTH - 0.007, 1.0]),
            np.eye(3),
            np.array([(right - left) / 2, 0.007, 1.0]),
        )
    )
    upright = tx.wood(OAK, 16, along_x=False)
    for side, x in (("left", left + 0.0125), ("right", right - 0.0125)):
        room.box(f"upright {side}", (x, y, 0.0), (0.025, depth, 2.0), upright, "front left right")
    for i, z in enumerate((0.05, 0.43, 0.81, 1.19, 1.57, 1.975)):
        room.box(
            f"board {i}",
            (middle, y, z),
            (right - left - 0.05, depth, 0.025),
            oak,
            "front top bottom",
        )
        if i < 5:
            _shelf_load(room, i, left + 0.03, right - 0.03, z + 0.025)


def _shelf_load(room: Room, level: int, left: float, right: float, z: float) -> None:
    """Groups of books, a gap, now and then a box."""
    rng = np.random.default_rng([7, level])
    x, group = left, 0
    while right - x > 0.12:
        width = min(float(rng.uniform(0.16, 0.36)), right - x)
        height = float(rng.uniform(0.2, 0.31))
        deep = float(rng.uniform(0.17, 0.24))
        at = (x + width / 2, DEPTH - 0.02 - deep / 2, z)
        name = f"shelf {level} group {group}"
        if (level + 3 * group) % 7 == 4:
            tint = tuple(int(c) for c in rng.integers(90, 220, 3))
            paint = tx.fabric((tint[0], tint[1], tint[2]))
            room.box(name, at, (width * 0.9, deep, height * 0.7), paint, "front left right top")
        else:
            _books(room, name, at, width, deep, height)
        x += width + (float(rng.uniform(0.0, 0.12)) if group % 2 else 0.0)
        group += 1


def _books(
    room: Room, name: str, at: tuple[float, float, float], width: float, deep: float, high: float
) -> None:
    paint: dict[str, Painter] = {
        "front": tx.spines,
        "top": tx.wood((222, 214, 196), 12, along_x=False),
        "other": tx.plain((70, 60, 84), 10),
    }
    room.box(
        name, at, (width, deep, high), paint, "front left right top", texel=0.0025, importance=0.7
    )


def _east_side(room: Room) -> None:
    window: dict[str, Any] = {"thick": 0.02, "emission": WINDOW_LIGHT, "importance": 1.2}
    _panel(room, "east", "window", 2.5, 0.9, 1.9, 1.3, tx.outside, **window)
    cloth = tx.curtain((168, 74, 60))
    for name, y in (("south", 1.36), ("north", 3.64)):
        room.box(
            f"curtain {name}",
            (WIDTH - 0.06, y, 0.12),
            (0.07, 0.46, 2.26),
            cloth,
            "front back left",
            texel=0.004,
        )
    ribs: dict[str, Painter] = {"left": tx.radiator, "other": tx.plain((226, 224, 218))}
    room.box(
        "radiator",
        (WIDTH - 0.07, 2.5, 0.14),
        (0.1, 1.3, 0.56),
        ribs,
        "left front back top",
        importance=2.0,
    )
    room.box(
        "sill",
        (WIDTH - 0.09, 2.5, 0.87),
        (0.18, 1.8, 0.03),
        tx.plain(WHITE),
        "left front back top bottom",
    )
    room.prism(
        "sill pot", (WIDTH - 0.1, 2.05, 0.9), 0.055, 0.11, tx.plain((222, 170, 60), 8), 8, 0.07
    )
    _leaves(room, "sill plant", (WIDTH - 0.1, 2.05, 1.0), 10, 0.2, 0.05, (84, 140, 76), 0.9)
    pole = tx.plain((60, 58, 56))
    room.box("lamp foot", (6.05, 0.42, 0.0), (0.28, 0.28, 0.03), pole)
    room.prism("lamp pole", (6.05, 0.42, 0.03), 0.014, 1.4, pole, 6)
    room.prism(
        "lamp shade",
        (6.05, 0.42, 1.38),
        0.2,
        0.28,
        tx.lamp((250, 226, 176)),
        12,
        0.14,
        emission=SHADE_LIGHT,
        texel=0.0016,
    )
    chess = tx.tiles((226, 214, 190), (60, 44, 36), 0.055)
    _panel(room, "east", "chess", 4.35, 1.2, 0.46, 0.46, tx.framed(chess, WALNUT, 0.012), 0.015)
    relief = tx.contours((226, 220, 196), (150, 110, 70), (150, 190, 216))
    _panel(
        room, "east", "relief", 0.85, 1.15, 0.6, 0.5, tx.framed(relief, OAK, 0.018), 0.015, 0.0022
    )


def _south_side(room: Room) -> None:
    cloth, seam = tx.fabric((70, 92, 112)), tx.fabric((82, 104, 124))
    room.box("sofa base", (4.5, 0.46, 0.08), (2.1, 0.82, 0.22), cloth, "back left right")
    for i, x in enumerate((3.99, 4.5, 5.01)):
        room.box(f"cushion {i}", (x, 0.52, 0.3), (0.505, 0.68, 0.14), seam, "back left right top")
    room.box("sofa back", (4.5, 0.14, 0.3), (2.1, 0.2, 0.52), cloth, "back left right top")
    for i, x in enumerate((3.56, 5.44)):
        room.box(f"arm {i}", (x, 0.46, 0.08), (0.22, 0.84, 0.5), cloth, "back left right top")
    striped = tx.fabric((214, 174, 84), (120, 44, 50), 0.06)
    room.box("pillow a", (4.0, 0.34, 0.45), (0.4, 0.13, 0.36), striped, yaw=-9)
    dots = tx.rug((206, 196, 180), (120, 130, 110), (170, 80, 60))
    room.box("pillow b", (5.08, 0.34, 0.45), (0.38, 0.13, 0.34), dots, yaw=12)
    island = tx.contours((212, 222, 190), (120, 100, 60), (120, 170, 206))
    _panel(
        room, "south", "island", 4.5, 1.15, 1.05, 0.75, tx.framed(island, OAK, 0.03), 0.02, 0.0022
    )
    fair = tx.printed((238, 228, 204), (28, 34, 52), ("ROBOT", "FAIR", "HALL 7"), (198, 54, 40))
    _panel(room, "south", "fair", 3.45, 1.05, 0.6, 0.85, fair, 0.006, 0.002)
    dusk = tx.landscape((236, 170, 120), (168, 110, 120), (40, 34, 60))
    _panel(room, "south", "dusk", 5.55, 1.2, 0.5, 0.62, tx.framed(dusk, WHITE, 0.02, 0.03), 0.015)
    _panel(room, "south", "clock", 2.5, 1.55, 0.34, 0.34, tx.clock, 0.03, mask=tx.disc)
    label: dict[str, Painter] = {"top": tx.cardboard("UP"), "other": tx.cardboard("ARCHIVE 3")}
    room.box("carton c", (2.85, 0.35, 0.0), (0.46, 0.4, 0.42), label, "back left right top", -6)
    _panel(room, "south", "socket", 1.2, 0.28, 0.16, 0.08, tx.plain((245, 245, 242), 2), 0.01)


def _west_side(room: Room) -> None:
    _panel(room, "west", "door", 0.9, 0.0, 0.92, 2.06, tx.door(), 0.03)
    _panel(room, "west", "switch", 1.5, 1.05, 0.08, 0.08, tx.plain((246, 246, 244), 2), 0.01)
    _panel(
        room,
        "west",
        "whiteboard",
        3.4,
        1.0,
        1.5,
        0.95,
        tx.framed(tx.whiteboard, (170, 172, 176), 0.02),
        0.02,
        0.0022,
    )
    _panel(
        room,
        "west",
        "calendar",
        2.2,
        1.25,
        0.42,
        0.6,
        tx.printed((246, 244, 238), (40, 40, 44), ("MAI", "2024"), (40, 100, 150)),
        0.006,
        0.002,
    )
    top = tx.wood((206, 178, 138), 14, along_x=False)
    room.box(
        "desk top", (0.36, 3.4, 0.72), (0.7, 1.5, 0.03), top, "front back left right top bottom"
    )
    steel = tx.plain((70, 72, 76))
    for i, (x, y) in enumerate(((0.66, 2.7), (0.66, 4.1), (0.06, 2.7), (0.06, 4.1))):
        room.box(f"desk leg {i}", (x, y, 0.0), (0.05, 0.05, 0.72), steel, "front back left right")
    drawers: dict[str, Painter] = {"right": _drawer_front, "other": tx.plain((210, 206, 198))}
    room.box("drawers", (0.36, 3.92, 0.0), (0.5, 0.34, 0.6), drawers, "front back right top")
    monitor: dict[str, Painter] = {"right": tx.screen, "other": tx.plain((28, 28, 30), 2)}
    room.box(
        "monitor",
        (0.2, 3.35, 0.86),
        (0.04, 0.62, 0.36),
        monitor,
        "front back right top bottom",
        texel=0.0025,
    )
    room.box(
        "monitor foot",
        (0.2, 3.35, 0.75),
        (0.16, 0.2, 0.11),
        tx.plain((28, 28, 30), 2),
        "front back right",
    )
    room.prism("mug", (0.5, 2.9, 0.75), 0.04, 0.09, tx.plain((190, 60, 48), 6), 10)
    room.prism("bin", (0.32, 2.4, 0.0), 0.12, 0.34, tx.plain((84, 104, 92), 8), 12, 0.15)
    _chair(room, (1.22, 3.3), 62.0)


def _drawer_front(canvas: Canvas) -> Array:
    colour = tx.plain((214, 210, 202))(canvas)
    x, y = canvas.grid()
    v = y % (canvas.height / 3)
    colour = tx.blend(colour, (110, 106, 100), 1 - tx.step(v, 0.008, 0.003))
    pull = (np.abs(x - canvas.width / 2) < 0.06) & (np.abs(v - 0.05) < 0.008)
    return tx.blend(colour, (70, 70, 74), pull.astype(float))


def _chair(room: Room, at: tuple[float, float], yaw: float) -> None:
    """A wooden chair; unturned it faces -y."""
    c, s = float(np.cos(np.radians(yaw))), float(np.sin(np.radians(yaw)))
    red, beech = tx.fabric((150, 62, 54)), tx.wood((190, 150, 104), 12, along_x=False)

    def place(dx: float, dy: float) -> tuple[float, float]:
        return round(at[0] + c * dx - s * dy, 6), round(at[1] + s * dx + c * dy, 6)

    full = "front back left right top bottom"
    room.box("chair seat", (*place(0, 0), 0.43), (0.42, 0.42, 0.045), red, full, yaw)
    for i, (dx, dy) in enumerate(((-0.18, -0.18), (0.18, -0.18), (-0.18, 0.18), (0.18, 0.18))):
        high = 0.43 if dy < 0 else 0.86
        room.box(
            f"chair leg {i}",
            (*place(dx, dy), 0.0),
            (0.04, 0.04, high),
            beech,
            "front back left right",
            yaw,
        )
    room.box("chair back", (*place(0, 0.18), 0.58), (0.34, 0.025, 0.26), red, full, yaw)


# ---------------------------------------------------------------- in the middle
def _middle(room: Room) -> None:
    pattern = tx.rug((122, 36, 40), (224, 196, 146), (38, 54, 86))
    corner = np.array([3.0, 3.2, 0.008])
    room.rectangle("rug", corner, np.array([2.2, 0, 0]), np.array([0, -1.6, 0]), pattern)
    room.solids.append(Solid(np.array([4.1, 2.4, 0.004]), np.eye(3), np.array([1.1, 0.8, 0.004])))
    oak = tx.wood(OAK, 18)
    room.box(
        "table top", (4.1, 2.4, 0.38), (1.0, 0.56, 0.035), oak, "front back left right top bottom"
    )
    for i, (dx, dy) in enumerate(((-0.45, -0.23), (0.45, -0.23), (-0.45, 0.23), (0.45, 0.23))):
        room.box(
            f"table leg {i}",
            (4.1 + dx, 2.4 + dy, 0.0),
            (0.05, 0.05, 0.38),
            oak,
            "front back left right",
        )
    cover: dict[str, Painter] = {
        "top": tx.printed((40, 90, 120), (240, 236, 220), ("MAPS", "AND", "WAYS"), (250, 200, 80)),
        "other": tx.plain((232, 226, 212)),
    }
    room.box("magazine", (3.86, 2.36, 0.415), (0.22, 0.29, 0.02), cover, yaw=20, texel=0.002)
    atlas: dict[str, Painter] = {
        "top": tx.contours((228, 214, 180), (140, 90, 60), (110, 160, 200)),
        "other": tx.plain((150, 60, 50)),
    }
    room.box("atlas", (4.33, 2.47, 0.415), (0.3, 0.22, 0.05), atlas, yaw=-25, texel=0.002)
    room.prism("bowl", (4.1, 2.52, 0.415), 0.05, 0.07, tx.plain((230, 226, 216), 5), 12, 0.09)
    blocks: dict[str, Painter] = {
        "other": tx.patches(((200, 60, 50), (60, 110, 160), (236, 190, 80)), 0.08)
    }
    room.box("pouf", (3.12, 2.55, 0.008), (0.42, 0.42, 0.38), blocks, yaw=30)


def _leaves(
    room: Room,
    name: str,
    at: tuple[float, float, float],
    count: int,
    length: float,
    width: float,
    colour: tuple[int, int, int],
    spread: float,
) -> None:
    """Leaves that fan out from a point; each is a two-sided rectangle with a leaf's outline."""
    golden = 2.399963
    for i in range(count):
        tilt = spread * (0.2 + 0.8 * ((i * 0.618) % 1))
        c, s = np.round([np.cos(i * golden), np.sin(i * golden)], 9)
        ct, st = np.round([np.cos(tilt), np.sin(tilt)], 9)
        size = length * (0.7 + 0.3 * ((i * 0.37) % 1))
        up = np.array([c * st, s * st, ct]) * size
        right = np.array([-s, c, 0.0]) * width
        base = np.array(at) + np.array([c, s, 0.0]) * 0.03
        shade = 0.8 + 0.4 * ((i * 0.73) % 1)
        tint = (round(colour[0] * shade), round(colour[1] * shade), round(colour[2] * shade))
        room.rectangle(
            f"{name}/{i}",
            base + up - right / 2,
            right,
            -up,
            tx.leaf(tint),
            0.004,
            mask=tx.leaf_shape,
            two_sided=True,
        )
