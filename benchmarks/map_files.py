"""Reading and writing of map files: time, size, and what the compact form loses.

    python benchmarks/map_files.py

The first table is of maps that the script makes (SH degree 3), medians of five runs with the
file in the disk cache; the second of trained maps, judged at twelve of their cameras.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from _data import data_folder

from igaussian_core.gaussian_map import GaussianMap, load_map, save_map
from igaussian_core.posed_images import read_posed_images
from igaussian_core.pruning import measure
from igaussian_core.view_planning import SourceView


def made_map(count: int) -> GaussianMap:
    rng = np.random.default_rng(0)
    quats = rng.normal(size=(count, 4)).astype(np.float32)
    return GaussianMap(
        rng.normal(size=(count, 3)).astype(np.float32),
        quats / np.linalg.norm(quats, axis=1, keepdims=True),
        np.exp(rng.normal(-4, 1, (count, 3))).astype(np.float32),
        rng.random(count).astype(np.float32),
        rng.normal(0, 0.15, (count, 16, 3)).astype(np.float32),
    )


def seconds(action: Callable[[], object], runs: int = 5) -> str:
    times = []
    for _ in range(runs):
        start = time.perf_counter()
        action()
        times.append(time.perf_counter() - start)
    return f"{statistics.median(times):.2f} s ({min(times):.2f} to {max(times):.2f})"


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        print("| Gaussians, SH 3 | file | MB | read | write |")
        print("|---|---|---|---|---|")
        for count in (100_000, 1_000_000):
            gmap = made_map(count)
            for suffix in (".ply", ".spz"):
                file = Path(folder) / f"map{suffix}"
                write = seconds(lambda f=file, g=gmap: save_map(g, f), 3)
                read = seconds(lambda f=file: load_map(f))
                megabytes = file.stat().st_size / 1e6
                print(f"| {count:,} | {suffix} | {megabytes:.1f} | {read} | {write} |")
        print("\n| trained map | .ply MB | .spz MB | PSNR to the .ply, mean | worst |")
        print("|---|---|---|---|---|")
        for name in ("fox", "lego", "redkitchen", "flower", "fern"):
            source = data_folder() / "sets" / name / "map.ply"
            gmap, file = load_map(source), Path(folder) / "map.spz"
            save_map(gmap, file)
            images = read_posed_images(source.with_name("poses.json"))
            views = [SourceView(i.camera.scaled_to_fit(640).undistorted(), i.T_scene_cam)
                     for i in images[:: max(1, len(images) // 12)]]  # fmt: skip
            psnr = measure(load_map(file), gmap, views)
            before, after = source.stat().st_size / 1e6, file.stat().st_size / 1e6
            print(f"| {name}, {len(gmap):,}, SH {gmap.sh_degree} | {before:.1f} | {after:.1f} "
                  f"| {psnr.mean():.1f} dB | {psnr.min():.1f} dB |")  # fmt: skip


if __name__ == "__main__":
    main()
