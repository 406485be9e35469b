"""Times, accuracy and memory of the CPU renderer, beside its oracle and other renderers.

    python benchmarks/render.py --json out.json
    python benchmarks/make_docs.py --keep out.json render       puts them into docs/benchmarks.md

Scenes are furnished rooms of surface-aligned Gaussians, SH 3, made here; the maps of the data
folder come on top where it is there (IGAUSSIAN_DATA, else ../shared/data). Images are 640x480,
RGB, depth and alpha. Wall times are what a caller waits, CPU times what the process spends (on a
machine with other work the better measure for one thread); each is a median with its quartiles
over the repeats. The torch reference runs once, on one thread, in float32 with 32-pixel tiles;
accuracy is judged by the same in float64.

Other renderers run where they are installed: `pip install gsplat==1.5.3 "gausscam[webgpu]"
splax` into an environment that has this package (none of them is a dependency).
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from render_peers import run_peers
from render_tables import section

from igaussian_core.camera import Camera
from igaussian_core.evaluate.report import machine_facts
from igaussian_core.gaussian_map import load_map
from igaussian_core.posed_images import read_posed_images
from igaussian_core.render import Rasterizer, available_simd
from igaussian_core.render import reference as oracle

CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
PIXELS = CAMERA.width * CAMERA.height
MAPS = ("fox", "lego", "redkitchen", "flower", "fern")
Arrays = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]
Views = list[tuple[Camera, np.ndarray]]


# --- scenes ---


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


def map_views(folder: Path, count: int = 8) -> Views:
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


# --- times ---


def timed(call: Callable[[], Any], repeats: int, warm_up: int = 2) -> dict[str, Any]:
    """Quartiles of wall and CPU milliseconds, and the least of each."""
    wall, cpu = [], []
    for i in range(repeats + warm_up):
        start_wall, start_cpu = time.perf_counter(), time.process_time()
        call()
        if i >= warm_up:
            wall.append((time.perf_counter() - start_wall) * 1e3)
            cpu.append((time.process_time() - start_cpu) * 1e3)
    quartiles = [25, 50, 75]
    return {
        "wall_ms": np.percentile(wall, quartiles).round(2).tolist(),
        "cpu_ms": np.percentile(cpu, quartiles).round(2).tolist(),
        "least_wall_ms": round(min(wall), 2),
        "least_cpu_ms": round(min(cpu), 2),
    }


def run_kernel(
    arrays: Arrays, views: Views, repeats: int, antialiased: bool = False
) -> list[dict[str, Any]]:
    """One row for each instruction set and number of threads."""
    return [
        _frames(Rasterizer(*arrays, antialiased=antialiased, simd=simd), views, threads, repeats)
        for simd in available_simd()
        for threads in (1, 2)
    ]


def _frames(
    rasterizer: Rasterizer, views: Views, threads: int, repeats: int
) -> dict[str, Any]:
    stats = []

    def frame() -> None:
        camera, T = views[len(stats) % len(views)]
        rasterizer.render(camera, T, threads=threads)
        stats.append(rasterizer.stats)

    times = timed(frame, max(repeats, len(views)))
    busy = np.median([s[:3] for s in stats], axis=0)
    pixels = views[0][0].width * views[0][0].height
    return {
        "simd": rasterizer.simd,
        "threads": threads,
        **times,
        "project_sort_blend_percent": (100 * busy / busy.sum()).round().tolist(),
        "visible": int(np.median([s.visible for s in stats])),
        "lanes_per_pixel": round(float(np.median([s.cells for s in stats])) * 16 / pixels, 1),
    }


def run_gradients(arrays: Arrays, T: np.ndarray, repeats: int) -> dict[str, Any]:
    rasterizer = Rasterizer(*arrays)
    by_rgb = np.random.default_rng(0).normal(size=(480, 640, 3)).astype(np.float32)
    times = timed(
        lambda: rasterizer.gradients(CAMERA, T, arrays, rgb=by_rgb, threads=1), repeats
    )
    packing = timed(lambda: Rasterizer(*arrays), 3, warm_up=1)
    return {"threads": 1, **times, "packing_cpu_ms": packing["cpu_ms"][1]}


def run_batch(arrays: Arrays, T: np.ndarray, repeats: int) -> dict[str, Any]:
    """64 views of 64x64, one by one and in one call, two threads."""
    rasterizer = Rasterizer(*arrays)
    camera = Camera(64, 64, 52.5, 52.5, 31.5, 31.5)
    poses = np.tile(T, (64, 1, 1))
    poses[:, 0, 3] += np.linspace(-0.3, 0.3, 64)
    loop = timed(lambda: [rasterizer.render(camera, P, threads=2) for P in poses], repeats)
    batch = timed(lambda: rasterizer.render_batch(camera, poses, threads=2), repeats)
    return {
        "views": 64,
        "one_by_one_wall_ms": loop["wall_ms"],
        "batch_wall_ms": batch["wall_ms"],
        "batch_cpu_ms": batch["cpu_ms"],
    }


# --- against the oracle ---


def run_oracle(arrays: Arrays, T: np.ndarray) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Figures of the float32 reference on one thread, and of all against the float64 one."""
    torch.set_num_threads(1)
    tensors = [torch.tensor(array) for array in arrays]
    pose = torch.tensor(T, dtype=torch.float32)
    single: list[oracle.ReferenceRender] = []
    with torch.no_grad():
        times = timed(
            lambda: single.append(oracle.render_reference(*tensors, CAMERA, pose)), 1, warm_up=0
        )
        pairs = 0
        for row in oracle.tiles(oracle.project(*tensors, CAMERA, pose), CAMERA, 32):
            for tile in row:
                pairs += int((oracle.weights(tile.gaussians, tile.pixels) > 0).sum())
        exact = [tensor.double() for tensor in tensors]
        truth = oracle.render_reference(*exact, CAMERA, torch.tensor(T))
    figures = {"cpu_ms": round(times["cpu_ms"][1]), "contributions_per_pixel": pairs / PIXELS}
    errors = [
        {"of": simd, **difference(Rasterizer(*arrays, simd=simd).render(CAMERA, T), truth)}
        for simd in available_simd()
    ]
    reference = oracle.ReferenceRender(*(part.numpy() for part in single[0]))
    return figures, [*errors, {"of": "the reference in float32", **difference(reference, truth)}]


def difference(render: Any, truth: oracle.ReferenceRender) -> dict[str, Any]:
    """Colour as it is, depth relative and where alpha > 0.5."""
    colour = np.abs(render.rgb - truth.rgb.numpy()).max(axis=2)
    solid = truth.alpha.numpy() > 0.5
    depth = np.abs(render.depth[solid] / truth.depth.numpy()[solid] - 1)
    return {
        "rgb_99_percent": float(np.quantile(colour, 0.99)),
        "rgb_max": float(colour.max()),
        "rgb_pixels_above_2e-3": int((colour > 2e-3).sum()),
        "depth_99_99_percent": float(np.quantile(depth, 0.9999)),
        "depth_max": float(depth.max()),
    }


# --- memory ---


def run_memory(count: int = 3_000_000) -> dict[str, Any]:
    """Of a large map, in a process of its own: what stays is not blurred by what was freed."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "memory.json"
        command = [sys.executable, __file__, "--memory-of", str(count), "--json", str(file)]
        subprocess.run(command, check=True)
        figures: dict[str, Any] = json.loads(file.read_text())
    return figures


def memory_of(count: int) -> dict[str, Any]:
    arrays, T = furnished_room(count), room_pose()
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)  # what making them left behind
    start = _resident_mb()
    rasterizer = Rasterizer(*arrays)
    packed = _resident_mb() - start
    figures = {
        "gaussians": count,
        "arrays_mb": round(sum(array.nbytes for array in arrays) / 1e6),
        "packed_mb": round(packed),
    }
    for name, camera in (("640x480", CAMERA), ("1920x1080", CAMERA.resized(1920, 1080))):
        times = timed(lambda camera=camera: rasterizer.render(camera, T, threads=2), 5)
        figures[name] = {
            "wall_ms": times["wall_ms"],
            "with_frame_buffers_mb": round(_resident_mb() - start),
        }
    return figures


def _resident_mb() -> float:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmRSS"):
            return int(line.split()[1]) / 1e3
    raise OSError("/proc/self/status has no VmRSS")


# --- the run ---


def room_report(count: int, repeats: int, with_oracle: bool) -> dict[str, Any]:
    arrays, T = furnished_room(count), room_pose()
    report: dict[str, Any] = {
        "scene": f"room, {count:,}",
        "gaussians": count,
        "kernel": run_kernel(arrays, [(CAMERA, T)], repeats),
        "gradients": run_gradients(arrays, T, max(3, repeats // 3)),
        "batch": run_batch(arrays, T, max(3, repeats // 10)),
    }
    if with_oracle:
        report["oracle"], report["accuracy"] = run_oracle(arrays, T)
    return report


def map_report(folder: Path, repeats: int) -> dict[str, Any]:
    gmap = load_map(folder / "map.ply")
    arrays = (gmap.means, gmap.quats_wxyz, gmap.scales, gmap.opacities, gmap.sh)
    views = map_views(folder)
    camera = views[0][0]
    return {
        "scene": f"{folder.name}, {len(gmap):,}, {camera.width}x{camera.height}",
        "gaussians": len(gmap),
        "kernel": run_kernel(arrays, views, repeats, gmap.antialiased),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="where to write all figures")
    parser.add_argument("--scenes", default="50000,100000,500000,1000000")
    parser.add_argument("--repeats", type=int, default=40)
    parser.add_argument("--no-oracle", action="store_true", help="leave the slow reference out")
    parser.add_argument("--memory-of", type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.memory_of:
        arguments.json.write_text(json.dumps(memory_of(arguments.memory_of)))
        return
    data: dict[str, Any] = {"facts": machine_facts(), "scenes": []}
    for count in filter(None, arguments.scenes.split(",")):
        report = room_report(int(count), arguments.repeats, not arguments.no_oracle)
        data["scenes"].append(report)
        print(f"{report['scene']}: done", flush=True)
    folders, reason = data_maps()
    if reason:
        print(f"maps skipped: {reason}")
    for folder in folders:
        data["scenes"].append(map_report(folder, arguments.repeats))
        print(f"{folder.name}: done", flush=True)
    data["memory"] = run_memory()
    data["peers"] = run_peers(furnished_room(50_000), CAMERA, room_pose())
    if arguments.json:
        arguments.json.write_text(json.dumps(data, indent=1))
    print("\n" + section(data))


if __name__ == "__main__":
    main()
