"""What polishing by brightness changes: held-out photos and the bundled drive, with and without.

Photos are localized from nothing, the drive is tracked; no frame has a time limit. `better` is the
share of the frames, accepted both times, whose rotation and position come nearer to the truth.

    python benchmarks/photometric.py [--work folder] [--json out.json] [--threads 2]
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from _data import data_folder
from numpy.typing import NDArray
from photos import CASES, compiled

from igaussian_core.bags import Bag
from igaussian_core.compile_map import compile_map
from igaussian_core.config import Config
from igaussian_core.evaluate.drive import Trajectory
from igaussian_core.evaluate.photos import PhotoQueries, held_out_images
from igaussian_core.geometry import pose_error
from igaussian_core.localizer import Localizer
from igaussian_core.result import LocalizationResult
from igaussian_core.tracker import Tracker

Array = NDArray[np.float64]
Answers = Iterator[tuple[LocalizationResult, Array]]  # with the true pose


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--work", type=Path)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--threads", type=int, default=2)
    arguments = parser.parse_args()
    print("| set | frames | without: median, p90 | with: median, p90 | better | ms of a frame's |")
    print("|---|---|---|---|---|---|")
    report = {}
    with tempfile.TemporaryDirectory() as temporary:
        for name, answers in _tracks(arguments.work or Path(temporary)):
            off, on = (
                _measured(answers(_config(mode, arguments.threads))) for mode in ("off", "polish")
            )
            report[name] = _row(name, off, on)
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=1))


def _config(mode: str, threads: int) -> Config:
    return Config.from_flat(
        {"refine.photometric": mode, "runtime.threads": threads, "runtime.budget_ms": 60000.0}
    )


def _tracks(work: Path) -> Iterator[tuple[str, Callable[[Config], Answers]]]:
    for name, data_set, with_cameras, kind, prefix in CASES[:5]:
        folder = data_folder() / "sets" / data_set
        package = compiled(work, name, folder, with_cameras, kind)
        held_out = held_out_images(folder / "poses.json", None)
        images = tuple(image for image in held_out if image.name.startswith(prefix))

        def photos(config: Config, package=package, images=images) -> Answers:
            localizer = Localizer.open(package, config)
            red, green, blue = localizer.manifest.background
            queries = PhotoQueries(images, localizer.T_map_scene, (red, green, blue))
            for index in range(len(queries)):
                yield localizer.localize(*queries.image(index)), queries.truth(index)

        yield name, photos
    demo, target = Path(__file__).resolve().parents[1] / "bags" / "demo", work / "room.igmap"
    if not target.is_dir():
        compile_map(demo / "room.ply", target, demo / "mapping_cameras.json")

    def drive(config: Config) -> Answers:
        tracker = Tracker(Localizer.open(target, config), config)
        with Bag(demo / "drive") as bag:
            truth = Trajectory(bag.poses())
            for frame in bag.frames():
                T_true = truth.at(frame.stamp_ns)
                result = tracker.process(frame)
                if T_true is not None:
                    yield result, T_true

    yield "drive", drive


def _measured(answers: Answers) -> Array:
    """Degrees, distance, ms, ms of polishing [N, 4]; errors are NaN where no pose was accepted."""
    return np.array([
        (*(pose_error(r.T_map_cam, T) if r.T_map_cam is not None else (np.nan, np.nan)),
         r.timings_ms["total"], r.timings_ms.get("polish", 0.0))
        for r, T in answers
    ])  # fmt: skip


def _row(name: str, off: Array, on: Array) -> dict[str, object]:
    both = np.isfinite(off[:, 0]) & np.isfinite(on[:, 0])

    def errors(found: Array) -> str:
        angle, distance = found[both, 0], found[both, 1]
        return (f"{np.median(angle):.4f} deg, {np.median(distance):.5f}; "
                f"{np.percentile(angle, 90):.3f} deg, {np.percentile(distance, 90):.4f}")

    better = (on[both, :2] < off[both, :2]).mean(axis=0)
    print(f"| {name} | {both.sum()} | {errors(off)} | {errors(on)} "
          f"| {better[0]:.0%}, {better[1]:.0%} | {np.median(on[both, 3]):.0f} of "
          f"{np.median(on[both, 2]):.0f} |", flush=True)  # fmt: skip
    return {"without": off.tolist(), "with": on.tolist()}


if __name__ == "__main__":
    main()
