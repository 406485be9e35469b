#!/usr/bin/env python3
"""Make the bundled demo: the Gaussian map of a room and a recorded drive through that room.

    python bags/make_demo.py                    everything, into bags/demo
    python bags/make_demo.py --out DIR          everything, elsewhere
    python bags/make_demo.py --only map         map, cameras or drive alone
    python bags/make_demo.py --check            remake in memory, compare with bags/demo

The result depends on nothing but the code: all random numbers have fixed seeds.
"""

from __future__ import annotations

import argparse
import hashlib
import sys
from pathlib import Path

import cv2
import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

from demo_room import sensor  # noqa: E402
from demo_room.drive import Drive  # noqa: E402
from demo_room.gaussians import build_gaussians, ply_bytes  # noqa: E402
from demo_room.lighting import bake  # noqa: E402
from demo_room.raycast import RayCaster  # noqa: E402
from demo_room.recording import read_jpegs, write_mapping_cameras, write_recording  # noqa: E402
from demo_room.room import build_room  # noqa: E402
from demo_room.surfaces import Image, Room  # noqa: E402

GAUSSIANS = 140_000  # 7.8 MB
PARTS = ("map", "cameras", "drive")
CHECKED_IMAGES = (0, 110, 219)


def lit_room() -> Room:
    """The room with its light baked in: what the map and the images share."""
    room = build_room()
    bake(room)
    return room


def map_bytes(room: Room) -> bytes:
    """The map's .ply file."""
    return ply_bytes(build_gaussians(room, GAUSSIANS))


def make(folder: Path, parts: tuple[str, ...]) -> None:
    """Write the chosen parts into folder."""
    folder.mkdir(parents=True, exist_ok=True)
    if "cameras" in parts:
        write_mapping_cameras(folder / "mapping_cameras.json")
    if not {"map", "drive"} & set(parts):
        return
    room = lit_room()
    if "map" in parts:
        (folder / "room.ply").write_bytes(map_bytes(room))
        print(f"{folder / 'room.ply'}: done", flush=True)
    if "drive" in parts:
        write_recording(room, folder / "drive")
        print(f"{folder / 'drive'}: done", flush=True)


def check(folder: Path) -> bool:
    """Whether remaking gives the map's bytes and (on a few images) the drive's pixels."""
    room = lit_room()
    made, stored = map_bytes(room), (folder / "room.ply").read_bytes()
    same_map = made == stored
    for label, data in (("made", made), ("stored", stored)):
        print(f"room.ply {label}: sha256 {hashlib.sha256(data).hexdigest()}")
    camera = sensor.CameraModel(RayCaster(room), Drive())
    recorded = read_jpegs(folder / "drive")
    same_images = True
    for index in CHECKED_IMAGES:
        remade, kept = _decoded(sensor.to_jpeg(camera.photo(index))), _decoded(recorded[index])
        different = int((remade != kept).any(2).sum())
        print(f"image {index}: {different} pixels differ")
        same_images &= different == 0
    return same_map and same_images


def _decoded(jpeg: bytes) -> Image:
    return np.asarray(cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR), np.uint8)


def main() -> int:
    parser = argparse.ArgumentParser(description="Make the bundled demo map and recording.")
    parser.add_argument("--out", type=Path, default=HERE / "demo", help="folder to write into")
    parser.add_argument("--only", choices=PARTS, help="make one part")
    parser.add_argument("--check", action="store_true", help="compare instead of writing")
    options = parser.parse_args()
    if options.check:
        return 0 if check(options.out) else 1
    make(options.out, (options.only,) if options.only else PARTS)
    return 0


if __name__ == "__main__":
    sys.exit(main())
