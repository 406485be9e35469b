"""Is the covariance true? NEES and coverage by data set, for held-out photos and for renders.

Where it is, e^T C^-1 e is 6 on average and 95 % of the errors lie inside the 95 % ellipsoid. Photos
are those the map was not trained on. Renders come from the map itself, near its training cameras,
with another brightness and noise: they know nothing of the map's own errors, so a covariance that
allows for these is too large for them.

A second table calibrates each map as `igaussian map calibrate` does and shows poses that this did
not see: lego's test views by its 13 held-out training views, and each half of them (every second
one) by the other; redkitchen's photos each by the others; each half of the bundled drive by the
other half. The other sets have too few photos.

    python benchmarks/covariance.py [--work folder] [--renders 20] [--json out.json]
        [--set refine.covariance_inflation=4 ...]
"""

from __future__ import annotations

import argparse
import json
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from _data import data_folder
from _facts import facts
from _maps import DEMO_ROOM, compiled_path
from numpy.typing import NDArray
from photos import CASES, compiled
from tables import covariance

from igaussian_core.bags import Bag
from igaussian_core.calibrate import MIN_POSES, covariance_scale
from igaussian_core.camera import Camera
from igaussian_core.cli_tools import load_config
from igaussian_core.compile_map import training_images
from igaussian_core.config import Config
from igaussian_core.evaluate.drive import Trajectory
from igaussian_core.evaluate.metrics import (
    NEES_95,
    QueryOutcome,
    normalized_error_squared,
    plain,
    summarize,
)
from igaussian_core.evaluate.photos import PhotoQueries, extent, held_out_images
from igaussian_core.evaluate.runner import run
from igaussian_core.geometry import compose, rotation_from_vector
from igaussian_core.localizer import Localizer
from igaussian_core.posed_images import PosedImage
from igaussian_core.refine.refiner import to_u8
from igaussian_core.tracker import Tracker

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RenderQueries:
    """Renders of a map at known poses, brightness and noise by their number."""

    localizer: Localizer
    views: tuple[tuple[Camera, Array], ...]

    def __len__(self) -> int:
        return len(self.views)

    def name(self, index: int) -> str:
        return f"render {index}"

    def group(self, index: int) -> str:
        return ""

    def image(self, index: int) -> tuple[NDArray[np.uint8], Camera]:
        camera, T_map_cam = self.views[index]
        rgb, _, _ = self.localizer.render(camera, T_map_cam)
        rng = np.random.default_rng(index)
        noise = rng.normal(0, 0.012, rgb.shape)
        return to_u8((rgb * rng.uniform(0.8, 1.2) + noise).astype(np.float32)), camera

    def prior(self, index: int) -> Array | None:
        return None

    def truth(self, index: int) -> Array:
        return self.views[index][1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--work", type=Path)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--renders", type=int, default=20)
    parser.add_argument("--set", action="append", default=[], help="configuration, e.g. a.b=1")
    arguments = parser.parse_args()
    # no time limit, so that other work on the machine changes times and not answers
    config = load_config(None, ["runtime.budget_ms=60000", *arguments.set])
    report: dict[str, dict[str, object]] = {"facts": facts()}
    sets = report["sets"] = {}
    pooled: dict[str, list[QueryOutcome]] = {"photos": [], "renders": []}
    tests: dict[str, Test] = {}
    print("| set | poses | mean NEES | median NEES | inside the 95 % ellipsoid |")
    print("|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as temporary:
        for name, data_set, with_cameras, kind, prefix in CASES[:5]:
            folder = data_folder() / "sets" / data_set
            package = compiled(
                arguments.work or Path(temporary), name, folder, with_cameras, kind
            )
            localizer = Localizer.open(package, config)
            size = extent(training_images(folder / "map.ply", folder / "poses.json"))
            held_out = held_out_images(folder / "poses.json", None)
            photos = [i for i in held_out if i.name.startswith(prefix)]
            others = [i for i in held_out if not i.name.startswith(prefix)]
            red, green, blue = localizer.manifest.background
            tracks = {
                "photos": PhotoQueries(tuple(photos), localizer.T_map_scene, (red, green, blue)),
                "renders": RenderQueries(localizer, _views(localizer, folder, size, arguments)),
            }
            apart = PhotoQueries(tuple(others), localizer.T_map_scene, (red, green, blue))
            for track, queries in tracks.items():
                outcomes = run(lambda localizer=localizer: localizer, queries).outcomes
                pooled[track] += outcomes
                if track == "photos" and others:
                    seen = run(lambda localizer=localizer: localizer, apart).outcomes
                    tests[f"{name}, by other views"] = _apart(_nees(seen), _nees(outcomes))
                    even, odd = _nees(outcomes[::2]), _nees(outcomes[1::2])
                    tests[f"{name}, half by half"] = _half_by_half(even, odd)
                elif track == "photos":
                    tests[name] = _each_by_the_others(_nees(outcomes))
                sets[f"{name}, {track}"] = _row(f"{name}, {track}", outcomes, 0.05 * size)
    for track, outcomes in pooled.items():
        sets[f"all {track}"] = _row(f"all {track}", outcomes, float("inf"))
    drive = _drive(arguments.work, config)
    first, second = drive[: len(drive) // 2], drive[len(drive) // 2 :]
    tests["drive, half by half"] = _half_by_half(first, second)
    report["calibrated"] = {name: _calibrated(test) for name, test in tests.items()}
    print(covariance(report))
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=1))


def _nees(outcomes: list[QueryOutcome]) -> Array:
    values = np.array([o.nees for o in outcomes])
    return values[np.isfinite(values)]


@dataclass(frozen=True)
class Test:
    """NEES of poses, each with the factor that other poses gave."""

    nees: Array
    scales: Array
    calibrated_on: int


def _apart(seen: Array, test: Array) -> Test:
    """Poses judged by a factor that `seen` gave."""
    scale = covariance_scale(seen) if len(seen) >= MIN_POSES else np.nan
    return Test(test, np.full(len(test), scale), len(seen))


def _half_by_half(a: Array, b: Array) -> Test:
    """Each half judged by the factor that the other one gave."""
    parts = _apart(b, a), _apart(a, b)
    scales = np.concatenate([part.scales for part in parts])
    return Test(np.concatenate([a, b]), scales, min(len(a), len(b)))


def _each_by_the_others(nees: Array) -> Test:
    count = len(nees) - 1
    if count < MIN_POSES:
        return _apart(nees[:count], nees)
    return Test(
        nees, np.array([covariance_scale(np.delete(nees, i)) for i in range(len(nees))]), count
    )


def _drive(work: Path | None, config: Config) -> Array:
    """NEES of every frame of the bundled drive, tracked."""
    demo = Path(__file__).resolve().parents[1] / "bags" / "demo"
    with tempfile.TemporaryDirectory() as temporary:
        target = compiled_path(work or Path(temporary), DEMO_ROOM)
        tracker, found = Tracker(Localizer.open(target, config), config), []
        with Bag(demo / "drive") as bag:
            truth = Trajectory(bag.poses())
            for frame in bag.frames():
                result, T_true = tracker.process(frame), truth.at(frame.stamp_ns)
                if result.T_map_cam is not None and T_true is not None:
                    found.append(
                        normalized_error_squared(result.T_map_cam, result.covariance, T_true)
                    )
    return np.array(found)


def _calibrated(test: Test) -> dict[str, object]:
    found: dict[str, object] = {
        "poses": len(test.nees), "calibrated_on": test.calibrated_on, **_figures(test.nees)
    }  # fmt: skip
    if np.isfinite(test.scales).all():
        found["factor"] = float(np.median(test.scales))
        found["after"] = _figures(test.nees / test.scales)
    return found


def _figures(nees: Array) -> dict[str, float]:
    return {"mean_nees": float(nees.mean()), "inside_95": float((nees < NEES_95).mean())}


def _views(
    localizer: Localizer, folder: Path, size: float, arguments: argparse.Namespace
) -> tuple[tuple[Camera, Array], ...]:
    """Cameras 3 degrees and 3 % of the extent (one sigma an axis) off those of training photos."""
    rng = np.random.default_rng(0)
    photos: list[PosedImage] = training_images(folder / "map.ply", folder / "poses.json")
    views = []
    for index in rng.integers(len(photos), size=arguments.renders):
        off = compose(
            rotation_from_vector(rng.normal(0, np.radians(3), 3)), rng.normal(0, 0.03 * size, 3)
        )
        T_scene_cam = photos[index].T_scene_cam @ off
        camera = photos[index].camera.scaled_to_fit(640).undistorted()
        views.append((camera, localizer.T_map_scene.camera(T_scene_cam)))
    return tuple(views)


def _row(name: str, outcomes: list[QueryOutcome], max_distance: float) -> dict[str, object]:
    s = summarize(outcomes, 5.0, max_distance)
    print(f"| {name} | {s['accepted']:.0f} | {s['mean_nees']:.1f} | {s['median_nees']:.1f} "
          f"| {s['inside_95']:.1%} |", flush=True)  # fmt: skip
    return dict(plain(s))


if __name__ == "__main__":
    main()
