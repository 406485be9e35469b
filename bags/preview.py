#!/usr/bin/env python3
"""Pictures of the demo: recorded image, rendering of the map, its depth; and a plan of the drive.

`python bags/preview.py --out DIR` writes DIR/demo.jpg and DIR/plan.png; with `--psnr` it also
prints how close the map's renderings come to the noise-free ray-cast images.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import cv2
import numpy as np

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

from demo_room import sensor  # noqa: E402
from demo_room.drive import Drive, image_times, mapping_poses  # noqa: E402
from demo_room.lighting import bake  # noqa: E402
from demo_room.raycast import RayCaster  # noqa: E402
from demo_room.recording import read_jpegs  # noqa: E402
from demo_room.room import build_room  # noqa: E402
from demo_room.surfaces import Array, Image  # noqa: E402
from igaussian_core import Camera, GaussianMap, load_map  # noqa: E402

SHOWN = (5, 95, 135, 185)
PIXELS_PER_METRE = 140


def demo_camera() -> Camera:
    """The recording's camera."""
    K = sensor.camera_matrix()
    return Camera(
        sensor.WIDTH, sensor.HEIGHT, K[0, 0], K[1, 1], K[0, 2], K[1, 2], dist=sensor.DISTORTION
    )


def comparison(gmap: GaussianMap) -> Image:
    """Rows of undistorted photo, rendering at the true pose, rendered depth."""
    camera, drive = demo_camera(), Drive()
    recorded, rows = read_jpegs(HERE / "demo" / "drive"), []
    for index in SHOWN:
        bgr = cv2.imdecode(np.frombuffer(recorded[index], np.uint8), cv2.IMREAD_COLOR)
        photo, pinhole = camera.undistort(np.asarray(bgr, np.uint8))
        T_cam_map = np.linalg.inv(drive.T_map_cam(index / 10))
        rgb, depth, _ = gmap.render(pinhole, T_cam_map)
        rendered = np.clip(np.rint(rgb[..., ::-1] * 255), 0, 255).astype(np.uint8)
        near = np.clip(255 * (1 - depth / 6.5), 0, 255).astype(np.uint8)
        rows.append(np.hstack([photo, rendered, cv2.applyColorMap(near, cv2.COLORMAP_TURBO)]))
    return np.vstack(rows)


def print_psnr(gmap: GaussianMap) -> None:
    """PSNR of the map's renderings against ray-cast images, once a second of the drive."""
    room = build_room()
    bake(room)
    camera, drive = demo_camera(), Drive()
    model, values = sensor.CameraModel(RayCaster(room), drive), []
    for time in image_times()[::10]:
        clean, pinhole = camera.undistort(np.rint(model.clean(float(time))).astype(np.uint8))
        rgb, _, _ = gmap.render(pinhole, np.linalg.inv(drive.T_map_cam(float(time))))
        error = np.mean((np.clip(rgb * 255, 0, 255) - clean) ** 2)
        values.append(float(10 * np.log10(255**2 / error)))
    print(
        f"PSNR of {len(values)} views: mean {np.mean(values):.1f} dB, "
        f"median {np.median(values):.1f}, lowest {min(values):.1f}"
    )


def plan() -> Image:
    """The room from above: furniture, the drive (an arrow a second), mapping views."""
    room, drive = build_room(), Drive()
    shape = (round(room.depth * PIXELS_PER_METRE), round(room.width * PIXELS_PER_METRE), 3)
    image = np.full(shape, 250, np.uint8)

    def pixel(point: Array) -> tuple[int, int]:
        y = (room.depth - point[1]) * PIXELS_PER_METRE
        return round(point[0] * PIXELS_PER_METRE), round(y)

    for solid in room.solids:
        u, v = solid.axes[0] * solid.half[0], solid.axes[1] * solid.half[1]
        corners = [pixel(solid.centre + a + b) for a, b in ((u, v), (u, -v), (-u, -v), (-u, v))]
        if solid.centre[2] - solid.half[2] < 0.8:
            cv2.polylines(image, [np.array(corners)], True, (120, 90, 70), 1, cv2.LINE_AA)
    for T in mapping_poses():
        start, tip = pixel(T[:3, 3]), pixel(T[:3, 3] + 0.2 * T[:3, 2])
        cv2.line(image, start, tip, (190, 170, 60), 1, cv2.LINE_AA)
    for i, time in enumerate(image_times()):
        x, y, yaw = drive.base_at(float(time))
        place = np.array([x, y])
        cv2.circle(image, pixel(place), 2, (40, 40, 200), -1, cv2.LINE_AA)
        if i % 10 == 0:
            tip = pixel(place + 0.25 * np.array([np.cos(yaw), np.sin(yaw)]))
            cv2.arrowedLine(image, pixel(place), tip, (40, 40, 200), 2, cv2.LINE_AA, tipLength=0.3)
    return image


def main() -> None:
    parser = argparse.ArgumentParser(description="Pictures of the bundled demo.")
    parser.add_argument("--out", type=Path, required=True, help="folder to write into")
    parser.add_argument("--psnr", action="store_true", help="print the map's PSNR")
    parser.add_argument("--map", type=Path, default=HERE / "demo" / "room.ply", help="another map")
    options = parser.parse_args()
    folder, gmap = options.out, load_map(options.map)
    folder.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(folder / "demo.jpg"), comparison(gmap), [cv2.IMWRITE_JPEG_QUALITY, 88])
    cv2.imwrite(str(folder / "plan.png"), plan())
    if options.psnr:
        print_psnr(gmap)


if __name__ == "__main__":
    main()
