"""What pruning costs: PSNR against the whole map at views that the importances did not see.

    python benchmarks/pruning.py

Beside the measure of pruning.py stand two plainer ones: opacity, and opacity x area.
"""

from __future__ import annotations

import numpy as np
from _data import data_folder

from igaussian_core.gaussian_map import load_map
from igaussian_core.posed_images import read_posed_images
from igaussian_core.pruning import importance, measure, pruned
from igaussian_core.view_planning import SourceView


def main() -> None:
    print("| map | kept | opacity x area^(1/8) x (1 + pixels)^(1/4) | opacity | opacity x area |")
    print("|---|---|---|---|---|")
    for name in ("fox", "lego", "redkitchen", "flower"):
        folder = data_folder() / "sets" / name
        gmap = load_map(folder / "map.ply")
        images = read_posed_images(folder / "poses.json")
        views = [
            SourceView(image.camera.scaled_to_fit(480).undistorted(), image.T_scene_cam)
            for image in images[:: max(1, len(images) // 24)]
        ]
        judges, seen = views[3::4], [v for i, v in enumerate(views) if i % 4 != 3]
        area = np.prod(np.sort(gmap.scales, axis=1)[:, 1:].astype(np.float64), axis=1)
        opacity = gmap.opacities.astype(np.float64)
        for share in (0.75, 0.5, 0.25):
            keep = int(share * len(gmap))
            cells = [
                f"{np.mean(measure(pruned(gmap, keep, weights), gmap, judges)):.1f} dB"
                for weights in (importance(gmap, seen), opacity, opacity * area)
            ]
            print(f"| {name}, {len(gmap):,} | {share:.0%} |", " | ".join(cells), "|")


if __name__ == "__main__":
    main()
