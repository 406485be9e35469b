"""Real photos without a prior: every data set, bare maps, and photos of other scenes.

Maps are compiled into a temporary folder (or --work, reused on the next run), then every photo
that the map was not trained on is localized from nothing. Cross-scene pairs count the photos
of other sets that are accepted, which all would be wrong.

    python benchmarks/photos.py [--json out.json] [--work folder]
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
from pathlib import Path

from _data import data_folder
from _facts import facts
from _maps import compile_as_users_do

from igaussian_core.compile_map import training_images
from igaussian_core.evaluate.metrics import QueryOutcome, summarize, to_json
from igaussian_core.evaluate.photos import PhotoQueries, extent, held_out_images
from igaussian_core.evaluate.runner import run
from igaussian_core.localizer import Localizer
from igaussian_core.posed_images import PosedImage, read_posed_images

# name, set, training cameras given, kind, queries whose name starts so
CASES = (
    ("fox", "fox", True, None, ""),
    ("flower", "flower", True, None, ""),
    ("fern", "fern", True, None, ""),
    ("redkitchen", "redkitchen", True, None, ""),
    ("lego", "lego", True, None, "test"),
    ("lego, bare map", "lego", False, "object", "test"),
    ("redkitchen, bare map", "redkitchen", False, None, ""),
)
COLUMNS = (
    "| set | queries | within 5 deg and 5 % of the extent | median | p90 | coarse, median "
    "| mean NEES | fewest inliers, lowest ratio | ms, median |\n"
    "|---|---|---|---|---|---|---|---|---|"
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path)
    parser.add_argument("--work", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        work = arguments.work or Path(temporary)
        report = {
            "facts": facts(), "photos": _photos(work), "cross_scene": _cross_scene(work)
        }  # fmt: skip
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=1))


def _photos(work: Path) -> list[dict[str, object]]:
    print(COLUMNS)
    rows = []
    for name, data_set, with_cameras, kind, prefix in CASES:
        folder = data_folder() / "sets" / data_set
        localizer = Localizer.open(compiled(work, name, folder, with_cameras, kind))
        held_out = held_out_images(folder / "poses.json", None)
        images = [image for image in held_out if image.name.startswith(prefix)]
        size = extent(training_images(folder / "map.ply", folder / "poses.json"))
        outcomes = _localized(localizer, images)
        summary = summarize(outcomes, 5.0, 0.05 * size)
        rows.append(
            {"case": name, "extent": size, "summary": summary,
             "queries": [to_json(o) for o in outcomes]}
        )  # fmt: skip
        print(_row(name, summary, outcomes), flush=True)
    return rows


def _localized(localizer: Localizer, images: list[PosedImage]) -> list[QueryOutcome]:
    red, green, blue = localizer.manifest.background
    queries = PhotoQueries(tuple(images), localizer.T_map_scene, (red, green, blue))
    return run(lambda: localizer, queries).outcomes


def _row(name: str, s: dict[str, float], outcomes: list[QueryOutcome]) -> str:
    nees = [o.nees for o in outcomes if math.isfinite(o.nees)]
    accepted = [o for o in outcomes if o.accepted]
    return (
        f"| {name} | {s['queries']:.0f} | {s['success']:.1%} "
        f"| {s['median_deg']:.3f} deg, {s['median_distance']:.4f} "
        f"| {s['p90_deg']:.2f} deg, {s['p90_distance']:.4f} "
        f"| {s['coarse_median_deg']:.2f} deg, {s['coarse_median_distance']:.3f} "
        f"| {sum(nees) / max(len(nees), 1):.1f} "
        f"| {min(o.inliers for o in accepted)}, {min(o.inlier_ratio for o in accepted):.2f} "
        f"| {s['median_ms']:.0f} |"
    )


def _cross_scene(work: Path) -> list[dict[str, object]]:
    print("\n| map | photos of other scenes | accepted | most inliers | its ratio |")
    print("|---|---|---|---|---|")
    rows = []
    queries = {name: _some_photos(name) for name in
               ("fox", "flower", "fern", "redkitchen", "lego", "shelf", "desk5")}  # fmt: skip
    for name, data_set, with_cameras, kind, _ in CASES[:5]:
        folder = data_folder() / "sets" / data_set
        localizer = Localizer.open(compiled(work, name, folder, with_cameras, kind))
        others = [image for other, images in queries.items() if other != data_set
                  for image in images]  # fmt: skip
        results = [localizer.localize(image.read(), image.camera) for image in others]
        accepted, most = sum(r.ok for r in results), max(results, key=lambda r: r.inliers)
        rows.append({"map": name, "photos": len(others), "accepted": accepted,
                     "inliers": most.inliers, "ratio": most.inlier_ratio})  # fmt: skip
        print(f"| {name} | {len(others)} | {accepted} | {most.inliers} "
              f"| {most.inlier_ratio:.2f} |", flush=True)  # fmt: skip
    return rows


def _some_photos(name: str, count: int = 15) -> list[PosedImage]:
    images = read_posed_images(data_folder() / "sets" / name / "poses.json")
    return images[:: max(1, len(images) // count)][:count]


def compiled(
    work: Path, name: str, folder: Path, with_cameras: bool, kind: str | None
) -> Path:
    target = work / f"{name.replace(', ', '_').replace(' ', '_')}.igmap"
    if not target.is_dir():
        cameras = folder / "poses.json" if with_cameras else None
        compile_as_users_do(target, folder / "map.ply", cameras, kind)
    return target


if __name__ == "__main__":
    main()
