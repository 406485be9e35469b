"""How well Gaussians' sizes tell where a map's training cameras were (camera_traces.py).

For each data set with a map: the share of random positions in the enlarged bounding box that
look likelier than the true cameras do, in the median and for the worst camera.

    python benchmarks/camera_traces.py
"""

from __future__ import annotations

import numpy as np
from _data import data_folder

from igaussian_core.camera_traces import size_distance_correlation
from igaussian_core.gaussian_map import load_map
from igaussian_core.posed_images import read_posed_images


def main() -> None:
    rng = np.random.default_rng(0)
    print("| set | correlation at the cameras | random places above the median camera |")
    print("|---|---|---|")
    for name in ("redkitchen", "fox", "fern", "flower"):
        folder = data_folder() / "sets" / name
        gmap = load_map(folder / "map.ply")
        low, high = gmap.bounds()
        cameras = np.array([i.T_scene_cam[:3, 3] for i in read_posed_images(folder / "poses.json")])
        random = low - 0.75 * (high - low) + rng.random((4000, 3)) * 2.5 * (high - low)
        at_cameras = size_distance_correlation(gmap, cameras, low, high)
        elsewhere = size_distance_correlation(gmap, random, low, high)
        above = float((elsewhere > np.median(at_cameras)).mean())
        span = f"{at_cameras.min():.2f} to {at_cameras.max():.2f}"
        print(f"| {name} | {span} | {above:.1%} |")


if __name__ == "__main__":
    main()
