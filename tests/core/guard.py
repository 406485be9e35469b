"""The fixed evaluation that guards accuracy, and the command that stores its figures:

    python tests/core/guard.py            print the figures
    python tests/core/guard.py --store    write them to tests/data/guard.json

Store only where accuracy has improved, or where a loss is meant and said in the commit.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
from collections.abc import Callable
from pathlib import Path

from igaussian_core.bags import Bag
from igaussian_core.compile_map import CompileOptions, compile_map, training_images
from igaussian_core.config import Config
from igaussian_core.evaluate.drive import Trajectory, summarize_drive
from igaussian_core.evaluate.drive_run import run_drive
from igaussian_core.evaluate.image_changes import parse_change
from igaussian_core.evaluate.metrics import summarize
from igaussian_core.evaluate.photos import PhotoQueries, extent, held_out_images
from igaussian_core.evaluate.rendered import (
    RenderedQueries,
    camera_of,
    shows_enough,
    targets,
)
from igaussian_core.evaluate.runner import run
from igaussian_core.localizer import Localizer
from igaussian_core.map_package import MapPackage
from igaussian_core.sphere import sphere_of

ROOT = Path(__file__).resolve().parents[2]
STORED = ROOT / "tests" / "data" / "guard.json"
DEMO = ROOT / "bags" / "demo"
VIEWS = 120  # source views of each map, as by default
GUARDED = ("success", "wrong_accepted", "median_deg", "median_distance", "auc", "p95_distance")
_AT_LEAST = ("success", "auc")

# on a loaded machine a frame takes longer, but its answer must not change
CONFIG = Config.from_flat({"runtime.budget_ms": 60000.0})

Figures = dict[str, float]
Compile = Callable[[str], MapPackage]


def demo_rendered(compiled: Compile) -> Figures:
    """The rendered track in the demo room, the paper's colour changes."""
    package = compiled("room")
    camera = camera_of(package)
    usable = shows_enough(package.gaussians, camera)
    drawn = targets(sphere_of(package), 8, 0.2, 7, usable)
    red, green, blue = package.manifest.background
    queries = RenderedQueries(
        tuple(drawn), package.gaussians, camera, (red, green, blue), package.T_map_scene,
        (parse_change("paper"),),
    )  # fmt: skip
    return summarize(run(lambda: Localizer(package, CONFIG), queries).outcomes, 5.0, 0.05)


def demo_drive(compiled: Compile) -> Figures:
    """The first five seconds of the bundled drive, every frame, tracked."""
    localizer = Localizer(compiled("room"), CONFIG)
    with Bag(DEMO / "drive") as bag:
        truth = Trajectory(bag.poses(None))
        done = run_drive(bag, localizer, CONFIG, truth, duration_s=5.0, every_frame=True)
    s = summarize_drive(done.frames, len(done.frames), done.memory)
    return {
        "success": s["accepted_ratio"],
        "wrong_accepted": float(s["max_error_deg"] > 5 or s["max_error_m"] > 0.25),
        "median_deg": s["median_error_deg"],
        "median_distance": s["median_error_m"],
        "p95_distance": s["p95_error_m"],
    }


def photos(name: str, data: Path) -> Callable[[Compile], Figures]:
    """Held-out photos of a set, within 5 degrees and 5 % of the extent."""

    def measure(compiled: Compile) -> Figures:
        folder = data / "sets" / name
        package = compiled(name)
        images = held_out_images(folder / "poses.json", None)
        size = extent(training_images(folder / "map.ply", folder / "poses.json"))
        queries = PhotoQueries(tuple(images), package.T_map_scene)
        outcomes = run(lambda: Localizer(package, CONFIG), queries).outcomes
        return summarize(outcomes, 5.0, 0.05 * size)

    return measure


def cases(data: Path | None) -> dict[str, Callable[[Compile], Figures]]:
    """What is measured; photos where the data is there."""
    found: dict[str, Callable[[Compile], Figures]] = {
        "demo, rendered": demo_rendered, "demo, drive": demo_drive,
    }  # fmt: skip
    for name in ("fern", "redkitchen") if data is not None else ():
        found[f"{name}, photos"] = photos(name, data)  # type: ignore[arg-type]
    return found


def compiler(folder: Path, data: Path | None) -> Compile:
    """Compiles each map once."""
    made: dict[str, MapPackage] = {}

    def compiled(name: str) -> MapPackage:
        if name not in made:
            if name == "room":
                source, cameras = DEMO / "room.ply", DEMO / "mapping_cameras.json"
            else:
                assert data is not None
                source, cameras = (data / "sets" / name / f for f in ("map.ply", "poses.json"))
            options = CompileOptions(views=VIEWS)
            made[name] = compile_map(source, folder / f"{name}.igmap", cameras, options)
        return made[name]

    return compiled


def differences(name: str, now: Figures, stored: dict[str, object]) -> list[str]:
    """One line for each figure that is worse than stored by more than its tolerance."""
    figures: Figures = stored["figures"][name]  # type: ignore[index]
    tolerances: dict[str, list[float]] = stored["tolerances"]  # type: ignore[assignment]
    lines = []
    for key in figures:
        absolute, relative = tolerances[key]
        slack = absolute + relative * abs(figures[key])
        worse = figures[key] - now[key] if key in _AT_LEAST else now[key] - figures[key]
        if not worse <= slack:
            lines.append(f"{name}: {key} = {now[key]:.4g}, stored {figures[key]:.4g} ± {slack:.2g}")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--store", action="store_true")
    store = parser.parse_args().store
    default = ROOT.parent / "shared" / "data"
    data = Path(os.environ.get("IGAUSSIAN_DATA", default))
    if not (data / "sets").is_dir():
        raise SystemExit(f"{data}: no data; set IGAUSSIAN_DATA, as photos are guarded too")
    with tempfile.TemporaryDirectory() as folder:
        compiled = compiler(Path(folder), data)
        figures = {}
        for name, measure in cases(data).items():
            found = measure(compiled)
            figures[name] = {key: round(found[key], 6) for key in GUARDED if key in found}
            print(name, json.dumps(figures[name]), flush=True)
    if store:
        document = {**json.loads(STORED.read_text()), "figures": figures}
        STORED.write_text(json.dumps(document, indent=1) + "\n")
        print(f"stored: {STORED}")


if __name__ == "__main__":
    main()
