"""What `igaussian map info` guesses of maps whose kind and up axis are known (overview.py).

    python benchmarks/map_kinds.py
"""

from __future__ import annotations

from _data import data_folder

from igaussian_core.gaussian_map import load_map
from igaussian_core.overview import best_correlation, kind_of, likely_up

# by their cameras, or by looking at renders
TRUTH = {
    "sets/fern/map.ply": ("scene", "-y"), "sets/flower/map.ply": ("scene", "-y"),
    "sets/fox/map.ply": ("scene", "z"), "sets/redkitchen/map.ply": ("scene", "-y"),
    "splats/trained_22764.splat": ("scene", "-y"),
    "splats/trained_inria_sh3_9080.ply": ("scene", "-y"),
    "sets/lego/map.ply": ("object", "z"), "splats/biker.compressed.ply": ("object", "-y"),
    "splats/playbot_lod2_sog": ("object", "-y"),
}  # fmt: skip


def main() -> None:
    print("| map | best correlation | kind, true | up axis, true |")
    print("|---|---|---|---|")
    for name, (kind, axis) in TRUTH.items():
        gmap = load_map(data_folder() / name)
        guess = kind_of(gmap)
        up = likely_up(gmap, guess)
        print(f"| {name} | {best_correlation(gmap):.2f} | {guess}, {kind} "
              f"| {up.label} ({up.confidence}), {axis} |")  # fmt: skip


if __name__ == "__main__":
    main()
