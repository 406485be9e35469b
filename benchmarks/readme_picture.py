"""The picture of the README, from the report of `make demo`: docs/demo.jpg.

    make demo && python benchmarks/readme_picture.py
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
REPORT = ROOT / "out" / "demo"
HEIGHT = 480


def main() -> None:
    pictures = [cv2.imread(str(REPORT / name)) for name in ("overlay_1.png", "trajectory.png")]
    scaled = [
        cv2.resize(picture, (round(picture.shape[1] * HEIGHT / picture.shape[0]), HEIGHT),
                   interpolation=cv2.INTER_AREA)
        for picture in pictures
    ]  # fmt: skip
    quality = [cv2.IMWRITE_JPEG_QUALITY, 88]
    cv2.imwrite(str(ROOT / "docs" / "demo.jpg"), np.hstack(scaled), quality)


if __name__ == "__main__":
    main()
