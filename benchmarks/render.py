"""Times and accuracy of the CPU renderer, by scene, instruction set and number of threads.

    python benchmarks/render.py [--json out.json] [--scenes 50000,100000,...] [--repeats 30]

Scenes are furnished rooms of surface-aligned Gaussians, SH 3, made here; the maps of the data
folder come on top where it is there (IGAUSSIAN_DATA, else ../shared/data). Images are 640x480,
RGB, depth and alpha. Wall times are what a caller waits, CPU times what the process spends (on a
machine with other work the better measure for one thread); each is a median with its quartiles
over the repeats. The torch reference runs on one thread in float32 with 32-pixel tiles; accuracy
is judged by the same in float64.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from igaussian_core.camera import Camera
from igaussian_core.gaussian_map import load_map
from igaussian_core.posed_images import read_posed_images
from igaussian_core.render import Rasterizer, available_simd
from igaussian_core.render import reference as oracle

CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
MAPS = ("fox", "lego", "redkitchen", "flower", "fern")
Arrays = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def furnished_room(count: int, seed: int = 0, coverage: float = 0.72) -> Arrays:
    """count flat Gaussians on the faces of a room of 6 x 4 x 2.6 m and of ten boxes in it.

    coverage: standard deviation along the surface over the mean distance between neighbours.
    0.72 gives 33 to 39 contributing Gaussians a pixel, as trained indoor maps have.
    """
    rng = np.random.default_rng(seed)
    boxes = [(np.zeros(3), np.array([6, 4, 2.6]))]
    for _ in range(10):
        size = rng.uniform(0.3, 1.0, 3)
        low = rng.uniform((0.2, 0.2, 0), (5, 3, 1.2))
        boxes.append((low, low + size))
    faces = [
        (axis, end[axis], low, high)
        for low, high in boxes
        for axis in range(3)
        for end in (low, high)
    ]
    areas = np.array([np.prod(np.delete(high - low, axis)) for axis, _, low, high in faces])
    face = rng.choice(len(faces), count, p=areas / areas.sum())
    means = np.empty((count, 3))
    normal_axis = np.empty(count, np.int64)
    inside = rng.uniform(size=(count, 3))
    for number, (axis, at, low, high) in enumerate(faces):
        mine = face == number
        means[mine] = low + inside[mine] * (high - low)
        means[mine, axis] = at
        normal_axis[mine] = axis
    means[np.arange(count), normal_axis] += rng.normal(0, 0.005, count)
    spacing = np.sqrt(areas.sum() / count)
    scales = spacing * coverage * np.exp(rng.normal(0, 0.4, (count, 3)))
    scales[:, 2] = 0.15 * scales[:, :2].min(1)
    opacities = rng.beta(1.5, 1.5, count)
    sh = rng.normal(0, 0.05, (count, 16, 3))
    sh[:, 0] = rng.uniform(-1.5, 1.5, (count, 3))
    arrays = (means, _facing(normal_axis, rng.uniform(0, np.pi, count)), scales, opacities, sh)
    return tuple(array.astype(np.float32) for array in arrays)  # type: ignore[return-value]


def _facing(axis: np.ndarray, spin: np.ndarray) -> np.ndarray:
    """Quaternions wxyz that turn z to the given axis, after a spin about z."""
    half = np.sqrt(0.5)
    turn = np.array([[half, 0, half, 0], [half, -half, 0, 0], [1, 0, 0, 0]])[axis]
    w, x, y, z = turn.T
    c, s = np.cos(spin / 2), np.sin(spin / 2)
    return np.stack([w * c - z * s, x * c + y * s, y * c - x * s, z * c + w * s], 1)


def room_pose() -> np.ndarray:
    """T_cam_scene of a camera in a corner of the room that looks across it."""
    eye, target = np.array([0.5, 0.5, 1.5]), np.array([4.5, 3.0, 1.0])
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = [right, np.cross(forward, right), forward]
    T[:3, 3] = -T[:3, :3] @ eye
    return T


def timed(call: Callable[[], Any], repeats: int) -> dict[str, list[float]]:
    """Quartiles of wall and CPU milliseconds, after two calls to warm up."""
    wall, cpu = [], []
    for i in range(repeats + 2):
        start_wall, start_cpu = time.perf_counter(), time.process_time()
        call()
        if i >= 2:
            wall.append((time.perf_counter() - start_wall) * 1e3)
            cpu.append((time.process_time() - start_cpu) * 1e3)
    quartiles = [25, 50, 75]
    return {
        "wall_ms": np.percentile(wall, quartiles).round(2).tolist(),
        "cpu_ms": np.percentile(cpu, quartiles).round(2).tolist(),
        "best_wall_ms": [round(min(wall), 2)],
    }


def run_kernel(
    arrays: Arrays,
    views: list[tuple[Camera, np.ndarray]],
    repeats: int,
    simd_names: tuple[str, ...],
    antialiased: bool = False,
) -> list[dict[str, Any]]:
    results = []
    for simd in simd_names:
        rasterizer = Rasterizer(*arrays, antialiased=antialiased, simd=simd)
        for threads in (1, 2):
            shares = []

            def frame(
                rasterizer: Rasterizer = rasterizer,
                threads: int = threads,
                shares: list[tuple[float, ...]] = shares,
            ) -> None:
                camera, T = views[len(shares) % len(views)]
                rasterizer.render(camera, T, threads=threads)
                shares.append(rasterizer.stats[:3])

            times = timed(frame, max(repeats, len(views)))
            busy = np.median(shares, axis=0)
            results.append(
                {
                    "simd": simd,
                    "threads": threads,
                    **times,
                    "project_sort_blend_percent": (100 * busy / busy.sum()).round().tolist(),
                    "visible": rasterizer.stats.visible,
                    "lanes_per_pixel": round(rasterizer.stats.cells * 16 / 307200, 1),
                }
            )
    return results


def run_oracle(arrays: Arrays, T: np.ndarray) -> tuple[dict[str, Any], Any]:
    """Figures of the reference in float32 on one thread, and its images in float64."""
    torch.set_num_threads(1)
    tensors = [torch.tensor(array) for array in arrays]
    pose = torch.tensor(T, dtype=torch.float32)
    with torch.no_grad():
        times = timed(lambda: oracle.render_reference(*tensors, CAMERA, pose), 1)
        pairs = 0
        for row in oracle.tiles(oracle.project(*tensors, CAMERA, pose), CAMERA, 32):
            for tile in row:
                pairs += int((oracle.weights(tile.gaussians, tile.pixels) > 0).sum())
        exact = [tensor.double() for tensor in tensors]
        images = oracle.render_reference(*exact, CAMERA, torch.tensor(T))
    figures = {
        "wall_ms": round(times["wall_ms"][1]),
        "cpu_ms": round(times["cpu_ms"][1]),
        "million_contributions": round(pairs / 1e6, 2),
    }
    return figures, images


def accuracy(arrays: Arrays, T: np.ndarray, truth: Any, simd: str) -> dict[str, Any]:
    render = Rasterizer(*arrays, simd=simd).render(CAMERA, T)
    error = np.abs(render.rgb - truth.rgb.numpy())
    solid = truth.alpha.numpy() > 0.5
    depth = np.abs(render.depth / np.maximum(truth.depth.numpy(), 1e-9) - 1)[solid]
    return {
        "simd": simd,
        "rgb_99_percent": float(np.quantile(error, 0.99)),
        "rgb_99_99_percent": float(np.quantile(error, 0.9999)),
        "rgb_max": float(error.max()),
        "depth_relative_99_99_percent": float(np.quantile(depth, 0.9999)),
        "depth_relative_max": float(depth.max()),
    }


def run_gradients(arrays: Arrays, T: np.ndarray, repeats: int) -> dict[str, Any]:
    rasterizer = Rasterizer(*arrays)
    by_rgb = np.random.default_rng(0).normal(size=(480, 640, 3)).astype(np.float32)
    times = timed(
        lambda: rasterizer.gradients(CAMERA, T, arrays, rgb=by_rgb, threads=1), repeats
    )
    packing = timed(lambda: Rasterizer(*arrays), 3)
    return {"threads": 1, **times, "packing_cpu_ms": packing["cpu_ms"][1]}


def run_batch(arrays: Arrays, T: np.ndarray, repeats: int) -> dict[str, Any]:
    """64 views of 80x60, one by one and in one call, two threads."""
    rasterizer = Rasterizer(*arrays)
    camera = CAMERA.resized(80, 60)
    poses = np.tile(T, (64, 1, 1))
    poses[:, 0, 3] += np.linspace(-0.3, 0.3, 64)
    loop = timed(lambda: [rasterizer.render(camera, P, threads=2) for P in poses], repeats)
    batch = timed(lambda: rasterizer.render_batch(camera, poses, threads=2), repeats)
    return {
        "views": 64,
        "size": [80, 60],
        "one_by_one_wall_ms": loop["wall_ms"],
        "batch_wall_ms": batch["wall_ms"],
    }


def map_views(folder: Path, count: int = 8) -> list[tuple[Camera, np.ndarray]]:
    """Views of a set's own cameras, at most 640 pixels a side."""
    images = read_posed_images(folder / "poses.json")
    views = []
    for image in images[:: max(1, len(images) // count)][:count]:
        camera = image.camera.undistorted().scaled_to_fit(640)
        views.append((camera, np.linalg.inv(image.T_scene_cam)))
    return views


def data_maps() -> tuple[list[Path], str]:
    """The folders of maps, and where there is none the reason."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("IGAUSSIAN_DATA", default)) / "sets"
    found = [folder / name for name in MAPS if (folder / name / "map.ply").is_file()]
    return found, "" if found else f"{folder}: no maps there (set IGAUSSIAN_DATA)"


def room_report(count: int, repeats: int, with_oracle: bool) -> dict[str, Any]:
    arrays, T = furnished_room(count), room_pose()
    report: dict[str, Any] = {
        "scene": f"room, {count:,}",
        "kernel": run_kernel(arrays, [(CAMERA, T)], repeats, available_simd()),
        "gradients": run_gradients(arrays, T, max(3, repeats // 3)),
        "batch": run_batch(arrays, T, max(3, repeats // 10)),
    }
    if with_oracle:
        report["oracle"], images = run_oracle(arrays, T)
        report["accuracy"] = [accuracy(arrays, T, images, simd) for simd in available_simd()]
    return report


def map_report(folder: Path, repeats: int) -> dict[str, Any]:
    gmap = load_map(folder / "map.ply")
    arrays = (gmap.means, gmap.quats_wxyz, gmap.scales, gmap.opacities, gmap.sh)
    views = map_views(folder)
    camera = views[0][0]
    return {
        "scene": f"{folder.name}, {len(gmap):,}, {camera.width}x{camera.height}",
        "kernel": run_kernel(arrays, views, repeats, available_simd(), gmap.antialiased),
    }


def table(*columns: str) -> None:
    print("\n| " + " | ".join(columns) + " |")
    print("|---" * len(columns) + "|")


def print_tables(reports: list[dict[str, Any]]) -> None:
    table("scene", "path", "1 thread, CPU ms", "2 threads, wall ms", "best", "project/sort/blend %")
    for report in reports:
        for one, two in zip(report["kernel"][::2], report["kernel"][1::2], strict=True):
            cpu, wall = one["cpu_ms"], two["wall_ms"]
            share = "/".join(f"{p:.0f}" for p in one["project_sort_blend_percent"])
            print(
                f"| {report['scene']} | {one['simd']} | {cpu[1]:.1f} ({cpu[0]:.1f}-{cpu[2]:.1f}) "
                f"| {wall[1]:.1f} ({wall[0]:.1f}-{wall[2]:.1f}) | {two['best_wall_ms'][0]:.1f} "
                f"| {share} |"
            )
    rooms = [report for report in reports if "oracle" in report]
    if rooms:
        table("scene", "contributions", "torch reference, CPU ms", "times the kernel")
        for report in rooms:
            reference = report["oracle"]
            ratio = reference["cpu_ms"] / report["kernel"][0]["cpu_ms"][1]
            print(
                f"| {report['scene']} | {reference['million_contributions']} M "
                f"| {reference['cpu_ms']} | {ratio:.0f} |"
            )
        table("scene", "path", "RGB 99 %", "99.99 %", "max", "depth (relative) 99.99 %", "max")
        for report in rooms:
            for a in report["accuracy"]:
                values = [f"{value:.1e}" for value in list(a.values())[1:]]
                print(f"| {report['scene']} | {a['simd']} | {' | '.join(values)} |")
    table("scene", "gradients, CPU ms", "packing, CPU ms", "64 views 80x60, wall ms", "batch")
    for report in reports:
        if "gradients" in report:
            gradients, batch = report["gradients"], report["batch"]
            print(
                f"| {report['scene']} | {gradients['cpu_ms'][1]} | {gradients['packing_cpu_ms']} "
                f"| {batch['one_by_one_wall_ms'][1]} | {batch['batch_wall_ms'][1]} |"
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="where to write all figures")
    parser.add_argument("--scenes", default="50000,100000,500000,1000000")
    parser.add_argument("--repeats", type=int, default=30)
    parser.add_argument("--no-oracle", action="store_true", help="leave the slow reference out")
    arguments = parser.parse_args()
    reports = []
    for count in filter(None, arguments.scenes.split(",")):
        reports.append(room_report(int(count), arguments.repeats, not arguments.no_oracle))
        print(f"{reports[-1]['scene']}: done", flush=True)
    folders, reason = data_maps()
    if reason:
        print(f"maps skipped: {reason}")
    for folder in folders:
        reports.append(map_report(folder, arguments.repeats))
        print(f"{reports[-1]['scene']}: done", flush=True)
    print_tables(reports)
    if arguments.json:
        machine = {"cpus": os.cpu_count(), "machine": platform.machine(), "load": os.getloadavg()}
        arguments.json.write_text(json.dumps({"machine": machine, "scenes": reports}, indent=1))


if __name__ == "__main__":
    main()
