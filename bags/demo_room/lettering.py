"""A stroke font, so that texts do not depend on the fonts of an OpenCV version."""

from __future__ import annotations

import cv2
import numpy as np

from .surfaces import Image

# each letter is polylines on a grid 4 wide and 6 high: pairs xy, y down, strokes split by |
_BOWL = "10 01 05 16 36 45 41 30 10"
STROKES = {
    "A": "06 20 46|14 34",
    "B": "33 03|00 06 36 45 44 33 42 41 30 00",
    "C": "41 30 10 01 05 16 36 45",
    "D": "00 06 26 45 41 20 00",
    "E": "40 00 06 46|03 33",
    "F": "40 00 06|03 33",
    "G": "41 30 10 01 05 16 36 45 43 23",
    "H": "00 06|40 46|03 43",
    "I": "20 26",
    "J": "40 45 36 16 05",
    "K": "00 06|40 03 46",
    "L": "00 06 46",
    "M": "06 00 23 40 46",
    "N": "06 00 46 40",
    "O": _BOWL,
    "P": "06 00 30 41 42 33 03",
    "Q": _BOWL + "|34 46",
    "R": "06 00 30 41 42 33 03|23 46",
    "S": "41 30 10 01 02 13 33 44 45 36 16 05",
    "T": "00 40|20 26",
    "U": "00 05 16 36 45 40",
    "V": "00 26 40",
    "W": "00 16 22 36 40",
    "X": "00 46|40 06",
    "Y": "00 23 40|23 26",
    "Z": "00 40 06 46",
    "0": _BOWL + "|32 14",
    "1": "11 20 26",
    "2": "01 10 30 41 42 06 46",
    "3": "00 40 23 33 44 45 36 16 05",
    "4": "36 30 04 44",
    "5": "40 00 03 33 44 45 36 16 05",
    "6": "30 10 01 05 16 36 45 44 33 03",
    "7": "00 40 16",
    "8": "13 02 01 10 30 41 42 33 13 04 05 16 36 45 44 33",
    "9": "43 13 02 01 10 30 41 45 36 16",
    "-": "13 33",
    ".": "25 26",
}
_SHIFT = 4  # cv2's fixed-point bits


def write(
    image: Image,
    text: str,
    x: float,
    y: float,
    height: float,
    colour: tuple[int, int, int],
    bold: float = 0.16,
) -> None:
    """Draw text into image with its top-left at (x, y), all in pixels; bold is relative."""
    scale = height / 6
    thickness = max(1, round(height * bold))
    for index, letter in enumerate(text.upper()):
        left = x + index * 5.4 * scale
        for stroke in STROKES.get(letter, "").split("|"):
            if not stroke:
                continue
            grid = np.array([[int(c) for c in pair] for pair in stroke.split()], float)
            points = np.rint((grid * scale + [left, y]) * (1 << _SHIFT)).astype(np.int32)
            cv2.polylines(image, [points], False, colour, thickness, cv2.LINE_AA, _SHIFT)


def text_width(text: str, height: float) -> float:
    """Width in pixels that write() takes."""
    return (len(text) * 5.4 - 1.4) * height / 6
