"""The paper's tables and real photos, with other methods on the same queries and machine.

    python benchmarks/peers.py [--quick | --short] [--json out.json] [--work folder]
                               [--only table] [--methods ours,SfM]

Tables: the rendered track (layout of the paper's tables 1 and 3), pure rotation (table 2),
photos, the ablation (table 4), the number of source views (figure 5). Methods are described in
peer_methods.py; the slow one runs on fewer queries, which the table says. Finished runs are
kept in --work, so that an interrupted benchmark goes on. Methods that need a network trained on the
map are left out where stage_one.py trained none. With --methods only methods whose names contain
one of those run, and the other rows of --json stay as they are. Needs the data folder (_data.py)
and pycolmap (extra `bench`).
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from _data import data_folder
from _facts import facts
from _maps import DEMO_ROOM, compiled, trained_network
from peer_methods import (
    EssentialMatrix,
    GradientDescent,
    Reference,
    SfmSift,
    Staged,
    reference_of_map,
    reference_of_photo,
)
from rich.progress import track

from igaussian_core.compile_map import lift_landmarks, training_images
from igaussian_core.config import Config
from igaussian_core.evaluate.coarse_estimator import CoarseOnly
from igaussian_core.evaluate.image_changes import parse_change
from igaussian_core.evaluate.metrics import (
    QueryOutcome,
    by_group,
    plain,
    stage_times,
    summarize,
)
from igaussian_core.evaluate.photos import PhotoQueries, extent, held_out_images
from igaussian_core.evaluate.rendered import (
    RenderedQueries,
    camera_of,
    shows_enough,
    targets,
)
from igaussian_core.evaluate.runner import Estimator, Partial, Queries, run
from igaussian_core.geometry import compose, rotation_from_vector
from igaussian_core.localizer import Localizer
from igaussian_core.map_package import MapPackage
from igaussian_core.posed_images import PosedImage
from igaussian_core.sphere import sphere_of
from igaussian_core.view_planning import SourceView
from igaussian_core.views import spherical_views

ROOT = Path(__file__).resolve().parents[1]
SETS = ("fox", "flower", "fern", "redkitchen", "lego")
# figure 5: elevations of 4 azimuths each
VIEW_COUNTS = {
    8: (-30.0, 30.0), 12: (-45.0, 0.0, 45.0), 16: (-60.0, -30.0, 30.0, 60.0),
    20: (-60.0, -30.0, 0.0, 30.0, 60.0),
}  # fmt: skip


class NotTrained(Exception):
    """A method that needs a network trained on the map; there is none."""


@dataclass(frozen=True)
class Case:
    """Queries in a map with what every method may use, and what success is."""

    name: str
    map: str  # as _maps names it
    package: MapPackage
    references: Callable[[], list[Reference]]
    queries: Queries
    max_deg: float
    max_distance: float
    steps: int  # of gradient descent


@dataclass(frozen=True)
class Method:
    """A row of a table; `slow` ones run on a subset of the queries."""

    name: str
    open: Callable[[Case], Estimator]
    slow: bool = False


# no time limit, so that other work on the machine changes times and not answers
_UNLIMITED = {"runtime.budget_ms": 60000.0}
CONFIG = Config.from_flat(_UNLIMITED)
SOLVER = Config.from_flat(
    {**_UNLIMITED, "refine.solver": "paper", "refine.scale": "depth"}
)
SOLVER_VIT = Config.from_flat({**_UNLIMITED, "refine.solver": "paper", "refine.scale": "vit"})
LANDMARKS = Config.from_flat({**_UNLIMITED, "coarse.method": "landmarks"})
_HEADS = {**_UNLIMITED, "coarse.method": "network", "coarse.network_head": "attention",
          "coarse.network_renders": 0}  # fmt: skip
HEADS = Config.from_flat(_HEADS)
SIFT = dataclasses.replace(CONFIG, features=dataclasses.replace(CONFIG.features, matcher="sift"))


def _with_network(case: Case, trained_for: str) -> MapPackage:
    """The case's map with the network that stage_one.py trained on it."""
    network = trained_network(case.map, trained_for)
    if network is None:
        raise NotTrained
    return dataclasses.replace(case.package, network=network)


def _paper(**refine: Any) -> Callable[[Case], Estimator]:
    """The paper's stage one, then descriptors matched once and a solver. No wheel brings LoFTR's
    weights, so XFeat finds the matches."""
    settings = {f"refine.{k}": v for k, v in {"rounds": 1, **refine}.items()}
    config = Config.from_flat({**_HEADS, **settings})
    return lambda c: Staged(_with_network(c, "heads"), config, lambda r, q, T: r.match(q, T))


OURS = Method("ours", lambda c: Localizer(c.package, CONFIG))
CASCADE = Method(
    "ours, the map with a trained network", lambda c: Localizer(_with_network(c, "memory"), CONFIG)
)
PAPER = Method("paper: network + XFeat + RANSAC + ViT", _paper(solver="paper", scale="vit"))
SFM = Method("SfM, SIFT (pycolmap), PnP", lambda c: SfmSift(c.package, c.references(), CONFIG))
ESSENTIAL_SIFT = Method(
    "essential matrix, SIFT", lambda c: EssentialMatrix(c.package, c.references(), SIFT)
)
ESSENTIAL_XFEAT = Method(
    "essential matrix, XFeat", lambda c: EssentialMatrix(c.package, c.references(), CONFIG)
)


def _descent(start: str) -> Callable[[Case], Estimator]:
    return lambda c: GradientDescent(c.package, LANDMARKS, start, c.steps)


DESCENT_COARSE = Method("gradient descent from the landmarks' pose", _descent("coarse"), slow=True)
DESCENT_PRIOR = Method("gradient descent from the prior", _descent("prior"), slow=True)
PAPERS_SOLVER = Method(
    "our stage one, the paper's solver (XFeat, RANSAC), scale by depth",
    lambda c: Localizer(c.package, SOLVER),
)
PAPERS_SOLVER_VIT = Method(
    "our stage one, the paper's solver (XFeat, RANSAC), scale by ViT",
    lambda c: Localizer(c.package, SOLVER_VIT),
)
PEERS = (
    OURS, CASCADE, PAPER, PAPERS_SOLVER, PAPERS_SOLVER_VIT, SFM, ESSENTIAL_SIFT, ESSENTIAL_XFEAT,
    DESCENT_COARSE, DESCENT_PRIOR,
)  # fmt: skip


def _staged(refine: Callable[..., Any], **settings: Any) -> Callable[[Case], Estimator]:
    config = Config.from_flat(
        {**LANDMARKS.to_flat(), **{f"refine.{k}": v for k, v in settings.items()}}
    )
    return lambda c: Staged(c.package, config, refine)


ABLATION = (
    Method("paper: network + WPM (stage one)",
           lambda c: CoarseOnly(_with_network(c, "heads"), HEADS)),
    Method("paper: + XFeat, RANSAC, scale by depth", _paper(solver="paper", scale="depth")),
    Method("paper: + XFeat, RANSAC, scale by ViT", _paper(solver="paper", scale="vit")),
    Method("paper's stage one + XFeat, PnP in place of RANSAC and ViT", _paper()),
    PAPERS_SOLVER,
    PAPERS_SOLVER_VIT,
    Method("ours: network with memory (stage one)",
           lambda c: CoarseOnly(_with_network(c, "memory"), CONFIG)),
    Method("ours: landmarks alone (stage one)", lambda c: CoarseOnly(c.package, LANDMARKS)),
    Method("ours: + matching and PnP, one round",
           _staged(lambda r, q, T: r.match(q, T), rounds=1)),
    Method("ours: + matching and PnP, two rounds", _staged(lambda r, q, T: r.match(q, T))),
    Method("ours: landmarks + alignment, no matching", _staged(lambda r, q, T: r.align(q, T))),
    Method("ours: all, alignment in one round, no photometric alignment",
           _staged(lambda r, q, T: r.refine(q, T), align_rounds=1, photometric="off")),
    Method("ours: all but photometric alignment",
           _staged(lambda r, q, T: r.refine(q, T), photometric="off")),
    dataclasses.replace(OURS, name="ours: + photometric alignment"),
    CASCADE,
)  # fmt: skip


@dataclass(frozen=True)
class Scale:
    """How much is run."""

    each: int  # targets a bin
    slow_each: int  # of them for the slow method
    photos: int  # most photos a set
    slow_photos: int
    steps: int = 200  # of gradient descent
    methods: str = ""  # parts of the names of those that run, between commas
    references: int = 80  # most views that the peers are given


SCALES = {
    "full": Scale(20, 2, 20, 3), "short": Scale(6, 1, 6, 1, references=40),
    "quick": Scale(2, 1, 2, 1, steps=20, references=20),
}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="where to write all figures")
    parser.add_argument("--work", type=Path, default=ROOT / "out" / "peers")
    parser.add_argument("--quick", action="store_true", help="few queries: does it run?")
    parser.add_argument("--only", help="one table: rendered, rotation, photos, ablation, views")
    parser.add_argument("--short", action="store_true", help="a fifth of the queries")
    parser.add_argument("--methods", default="", help="parts of the names of those that run")
    options = parser.parse_args()
    name = "quick" if options.quick else "short" if options.short else "full"
    scale, work = SCALES[name], options.work / name
    work.mkdir(parents=True, exist_ok=True)
    tables = {
        "rendered": _rendered_table, "rotation": _rotation_table, "photos": _photo_table,
        "ablation": _ablation_table, "views": _views_table,
    }  # fmt: skip
    before = _report_before(options)
    report: dict[str, Any] = {"facts": facts()}
    report["facts"]["queries"] = (
        f"{scale.each} targets a bin ({scale.slow_each} for gradient descent), at most "
        f"{scale.photos} photos a set ({scale.slow_photos}), {scale.references} reference views"
    )
    report["facts"]["time limit of a frame"] = "none"
    if before:
        report["facts"]["rows of other methods"] = ", ".join(
            f"{k}: {before['facts'][k]}" for k in ("date", "machine", "commit")
        )
    for table, make in tables.items():
        if options.only in (None, table):
            rows = make(work, dataclasses.replace(scale, methods=options.methods))
            report[table] = _merged(before.get(table, []), rows)
            print_table(table, report[table])
        elif table in before:
            report[table] = before[table]
    if options.json:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps(report, indent=1) + "\n")


def _report_before(options: argparse.Namespace) -> dict[str, Any]:
    """What --json holds, where only some methods run."""
    if not options.methods or not options.json or not options.json.is_file():
        return {}
    before: dict[str, Any] = json.loads(options.json.read_text())
    return before


def _merged(before: list[dict[str, Any]], rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows from before, those measured now in place of theirs, and new ones."""

    def key(row: dict[str, Any]) -> tuple[str, str]:
        return row["case"], row["method"]

    measured = {key(row): row for row in rows}
    merged = []
    for row in before:
        merged.append(measured.pop(key(row), row))
    return merged + list(measured.values())


# --- tables ---


def _rendered_table(work: Path, scale: Scale) -> list[dict[str, Any]]:
    cases = [
        _rendered_case("lego", compiled(work.parent, "lego"), scale, source_prior=True),
        _rendered_case("demo room", compiled(work.parent, DEMO_ROOM), scale, source_prior=True),
    ]
    return [row for case in cases for row in _rows(case, PEERS, work, "rendered", scale)]


def _rotation_table(work: Path, scale: Scale) -> list[dict[str, Any]]:
    room = compiled(work.parent, DEMO_ROOM)
    case = _rendered_case("demo room", room, scale, True, pure_rotation=True)
    return _rows(case, PEERS, work, "rotation", scale)


def _photo_table(work: Path, scale: Scale) -> list[dict[str, Any]]:
    rows = []
    for name in SETS:
        rows += _rows(_photo_case(name, work, scale), PEERS, work, "photos", scale)
    return rows


def _ablation_table(work: Path, scale: Scale) -> list[dict[str, Any]]:
    """As table 4: pairs 20 to 40 degrees away, rendered; and the photos of a kitchen."""
    case = _rendered_case("demo room", compiled(work.parent, DEMO_ROOM), scale)
    kitchen = _photo_case("redkitchen", work, scale)
    near = dataclasses.replace(
        case.queries, targets=tuple(t for t in case.queries.targets if t.bin == "20-40")
    )
    near_case = dataclasses.replace(case, queries=near)
    return [
        *_rows(near_case, ABLATION, work, "ablation", scale),
        *_rows(kitchen, ABLATION, work, "ablation", scale),
    ]


def _views_table(work: Path, scale: Scale) -> list[dict[str, Any]]:
    """As figure 5: only so many spherical source views, no training camera is known."""
    whole, rows = compiled(work.parent, "lego"), []
    for count, elevations in VIEW_COUNTS.items():
        package = _with_views(whole, elevations)
        rendered = _rendered_case(f"lego, {count} views", package, scale)
        photos = _photo_case("lego", work, dataclasses.replace(scale, photos=5 * scale.photos))
        case = dataclasses.replace(photos, name=f"lego photos, {count} views", package=package)
        for part in (rendered, case):
            rows += [
                {**row, "views": count} for row in _rows(part, (OURS,), work, "views", scale)
            ]
    return rows


def _rows(
    case: Case, methods: Sequence[Method], work: Path, table: str, scale: Scale
) -> list[dict[str, Any]]:
    rows = []
    parts = scale.methods.split(",")
    chosen = [method for method in methods if any(part in method.name for part in parts)]
    for method in track(chosen, description=f"{table}: {case.name}"):
        row: dict[str, Any] = {"case": case.name, "method": method.name}
        try:
            outcomes = _outcomes(case, method, work, table, scale)
        except NotTrained:
            print(f"{case.name}: left out, no network trained: {method.name}", file=sys.stderr)
            continue
        limits = (case.max_deg, case.max_distance)
        row["summary"] = plain(summarize(outcomes, *limits))
        groups = by_group(outcomes)
        if len(groups) > 1:
            row["groups"] = {k: plain(summarize(v, *limits)) for k, v in groups.items()}
        row["stage_ms"] = {k: round(v["median_ms"], 1) for k, v in stage_times(outcomes).items()}
        if method.slow:
            row["iterations"] = case.steps
        rows.append(row)
    return rows


def _outcomes(
    case: Case, method: Method, work: Path, table: str, scale: Scale
) -> list[QueryOutcome]:
    queries = _subset(case.queries, scale) if method.slow else case.queries
    name = "".join(c if c.isalnum() else "_" for c in f"{table}-{case.name}-{method.name}")
    names = [queries.name(i) for i in range(len(queries))]
    key = json.dumps([names, case.steps, case.package.manifest.gaussians_sha256, CONFIG.to_flat()])
    partial = Partial(work / f"{name}.jsonl", key)
    return run(lambda: method.open(case), queries, partial).outcomes


def _subset(queries: Any, scale: Scale) -> Queries:
    """The first targets of each bin, or photos spread over the set."""
    if isinstance(queries, RenderedQueries):
        kept = [t for t in queries.targets if int(t.name.split("/")[1]) < scale.slow_each]
        return dataclasses.replace(queries, targets=tuple(kept))
    return dataclasses.replace(queries, images=_spread(queries.images, scale.slow_photos))


def _spread(images: Sequence[PosedImage], count: int) -> tuple[PosedImage, ...]:
    index = np.unique(np.linspace(0, len(images) - 1, min(count, len(images))).round().astype(int))
    return tuple(images[i] for i in index)


# --- cases ---


def _rendered_case(
    name: str,
    package: MapPackage,
    scale: Scale,
    source_prior: bool = False,
    pure_rotation: bool = False,
) -> Case:
    map_ = name.split(",")[0]
    sphere, camera = sphere_of(package), camera_of(package)
    usable = [shows_enough(package.gaussians, camera)] if sphere.kind == "scene" else []
    drawn = targets(sphere, scale.each, 0.0 if pure_rotation else 0.2, 0, *usable)
    red, green, blue = package.manifest.background
    queries = RenderedQueries(
        tuple(drawn), package.gaussians, camera, (red, green, blue), package.T_map_scene,
        (parse_change("paper"),), source_prior,
    )  # fmt: skip

    def references() -> list[Reference]:
        count = package.landmarks.view_count
        chosen = np.unique(np.linspace(0, count - 1, min(count, scale.references)).astype(int))
        return [reference_of_map(package, int(view), CONFIG) for view in chosen]

    limit = math.inf if pure_rotation else 0.05
    references_ = functools.cache(references)
    return Case(name, map_, package, references_, queries, 5.0, limit, scale.steps)


@dataclass(frozen=True)
class PriorPhotos(PhotoQueries):
    """Photos with a perturbed pose as prior: 10 degrees and 5 % of the extent off."""

    offset: float = 0.0

    def prior(self, index: int) -> np.ndarray:
        rng = np.random.default_rng(index)
        turn, move = rng.normal(size=3), rng.normal(size=3)
        turn *= np.radians(10) / np.linalg.norm(turn)
        move *= self.offset / np.linalg.norm(move)
        T = self.truth(index)
        return compose(rotation_from_vector(turn) @ T[:3, :3], T[:3, 3] + move)


def _photo_case(name: str, work: Path, scale: Scale) -> Case:
    folder = data_folder() / "sets" / name
    package = compiled(work.parent, name)
    training = training_images(folder / "map.ply", folder / "poses.json")
    held_out = held_out_images(folder / "poses.json", None)
    if name == "lego":
        held_out = [image for image in held_out if image.name.startswith("test")]
    red, green, blue = package.manifest.background
    size = extent(training)
    queries = PriorPhotos(
        _spread(held_out, scale.photos), package.T_map_scene, (red, green, blue),
        offset=0.05 * size,
    )  # fmt: skip

    def references() -> list[Reference]:
        ground = tuple(round(255 * value) for value in (red, green, blue))
        return [
            reference_of_photo(package, i.read(ground), i.camera, i.T_scene_cam, CONFIG)  # type: ignore[arg-type]
            for i in _spread(training, scale.references)
        ]

    references_ = functools.cache(references)
    return Case(name, name, package, references_, queries, 5.0, 0.05 * size, scale.steps)


def _with_views(package: MapPackage, elevations_deg: tuple[float, ...]) -> MapPackage:
    """The map with landmarks of spherical views only, and no network, which has seen others."""
    sphere, camera = sphere_of(package), camera_of(package)
    poses = spherical_views(
        sphere.kind, sphere.radius, sphere.centre, sphere.up, elevations_deg=elevations_deg
    )
    sources = [SourceView(camera, T) for T in poses]
    landmarks, _ = lift_landmarks(
        package.gaussians, sources, tuple(package.manifest.background), CONFIG,
        lambda stage, done, of: None,
    )  # fmt: skip
    return dataclasses.replace(package, landmarks=landmarks, network=None)


# --- printing ---


def print_table(name: str, rows: Sequence[dict[str, Any]]) -> None:
    """One table as Markdown, on stdout."""
    from tables import peers_markdown

    print(f"\n### {name}\n\n{peers_markdown(name, rows)}", flush=True)


if __name__ == "__main__":
    main()
