#!/usr/bin/env python3
"""Make the bundled demo: the Gaussian map of a room and a recorded drive through that room.

    python bags/make_demo.py                    everything, into bags/demo
    python bags/make_demo.py --out DIR          everything, elsewhere
    python bags/make_demo.py --only map         map, cameras or drive alone
    python bags/make_demo.py --only map --laid --out DIR    the map before it is fitted
    python bags/make_demo.py --check            remake in memory, compare with bags/demo

Run it in the project's environment: the map is fitted with the project's renderer. All random
numbers have fixed seeds: the same machine makes the same files, another one a map that looks
the same (demo_room/compare.py).
"""

from __future__ import annotations

import argparse
import hashlib
import sys
from pathlib import Path

import cv2
import numpy as np

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

from demo_room import sensor  # noqa: E402
from demo_room.compare import broken_rules, likeness  # noqa: E402
from demo_room.drive import Drive  # noqa: E402
from demo_room.fit import fit, fitting_poses, mapping_camera, take_view  # noqa: E402
from demo_room.gaussians import Gaussians, build_gaussians, parse_ply, ply_bytes  # noqa: E402
from demo_room.lighting import bake  # noqa: E402
from demo_room.raycast import RayCaster  # noqa: E402
from demo_room.recording import read_jpegs, write_mapping_cameras, write_recording  # noqa: E402
from demo_room.room import build_room  # noqa: E402
from demo_room.surfaces import Image, Room  # noqa: E402

GAUSSIANS = 140_000  # 7.8 MB
PARTS = ("map", "cameras", "drive")
CHECKED_IMAGES = (0, 110, 219)
LIKENESS = 50.0  # dB between two fits of the same laid map; see bags/README.md


def lit_room() -> Room:
    """The room with its light baked in: what the map and the images share."""
    room = build_room()
    bake(room)
    return room


def lay_map(room: Room) -> Gaussians:
    """The map before it is fitted: the same on any machine."""
    return build_gaussians(room, GAUSSIANS)


def fit_map(room: Room, laid: Gaussians) -> Gaussians:
    """The map of the demo; takes minutes, and says where it is."""
    caster, camera, poses = RayCaster(room), mapping_camera(), fitting_poses(room)
    views = []
    for index, T_map_cam in enumerate(poses):
        views.append(take_view(caster, camera, T_map_cam))
        if (index + 1) % 20 == 0 or index + 1 == len(poses):
            print(f"view {index + 1} of {len(poses)}", flush=True)
    return fit(laid, room, views, report=lambda line: print(line, flush=True))


def make(folder: Path, parts: tuple[str, ...], fitted: bool) -> None:
    """Write the chosen parts into folder; the map fitted, or only laid."""
    folder.mkdir(parents=True, exist_ok=True)
    if "cameras" in parts:
        write_mapping_cameras(folder / "mapping_cameras.json")
    if not {"map", "drive"} & set(parts):
        return
    room = lit_room()
    if "map" in parts:
        laid = lay_map(room)
        (folder / "room.ply").write_bytes(ply_bytes(fit_map(room, laid) if fitted else laid))
        print(f"{folder / 'room.ply'}: done", flush=True)
    if "drive" in parts:
        write_recording(room, folder / "drive")
        print(f"{folder / 'drive'}: done", flush=True)


def check(folder: Path) -> bool:
    """Whether remaking gives the map and (on a few images) the drive's pixels."""
    room = lit_room()
    same_map = _check_map(room, (folder / "room.ply").read_bytes())
    camera = sensor.CameraModel(RayCaster(room), Drive())
    recorded = read_jpegs(folder / "drive")
    same_images = True
    for index in CHECKED_IMAGES:
        remade, kept = _decoded(sensor.to_jpeg(camera.photo(index))), _decoded(recorded[index])
        different = int((remade != kept).any(2).sum())
        print(f"image {index}: {different} pixels differ")
        same_images &= different == 0
    return same_map and same_images


def _check_map(room: Room, stored: bytes) -> bool:
    """The same bytes; or, from another machine, a fit of the same laid map that looks the same."""
    laid = lay_map(room)
    made = ply_bytes(fit_map(room, laid))
    for label, data in (("made", made), ("stored", stored)):
        print(f"room.ply {label}: sha256 {hashlib.sha256(data).hexdigest()}")
    if made == stored:
        return True
    kept = parse_ply(stored)
    broken = broken_rules(kept, parse_ply(ply_bytes(laid)))
    if broken:
        print(f"room.ply stored: no fit of the laid map, see its {', '.join(broken)}")
        return False
    alike = likeness(kept, parse_ply(made))
    print(f"room.ply: {alike:.1f} dB between the renderings at worst, {LIKENESS:.0f} wanted")
    return alike >= LIKENESS


def _decoded(jpeg: bytes) -> Image:
    return np.asarray(cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR), np.uint8)


def main() -> int:
    parser = argparse.ArgumentParser(description="Make the bundled demo map and recording.")
    parser.add_argument("--out", type=Path, default=HERE / "demo", help="folder to write into")
    parser.add_argument("--only", choices=PARTS, help="make one part")
    parser.add_argument("--laid", action="store_true", help="do not fit the map, to compare")
    parser.add_argument("--check", action="store_true", help="compare instead of writing")
    options = parser.parse_args()
    if options.check:
        return 0 if check(options.out) else 1
    make(options.out, (options.only,) if options.only else PARTS, not options.laid)
    return 0


if __name__ == "__main__":
    sys.exit(main())
