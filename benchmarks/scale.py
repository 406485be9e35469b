"""How far does the paper's solver move? The learned scale against rendered depth.

Two tables. First the length alone: renders of a map at poses off by as much as stage one errs
(up to 10 degrees and 15 % of the median depth), matched with photos of the same map whose colours
are changed; the error of |t| by depth, by the network, and by the best constant. Then the whole
pipeline on the rendered track with either scale, and with PnP.

    python benchmarks/scale.py --map lego.igmap --map room.igmap [--pairs 60] [--each 12]
        [--procedural 3] [--json out.json]
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch
from _facts import facts
from numpy.typing import NDArray

import igaussian_core  # noqa: F401  before torch: says how idle threads wait
from igaussian_core.camera import Camera
from igaussian_core.config import Config
from igaussian_core.evaluate.image_changes import parse_change
from igaussian_core.evaluate.rendered import (
    RenderedQueries,
    camera_of,
    shows_enough,
    targets,
)
from igaussian_core.features import XFeatMatcher
from igaussian_core.gaussian_map import GaussianMap
from igaussian_core.geometry import compose, inverse, pose_error, rotation_from_vector
from igaussian_core.lifting import at_pixels, sample, trusted_depth
from igaussian_core.localizer import Localizer
from igaussian_core.map_package import open_package
from igaussian_core.procedural import make_object, make_room
from igaussian_core.refine.refiner import to_u8
from igaussian_core.refine.relative import bearings, depth_scale, relative_pose
from igaussian_core.refine.scale_vit import LearnedLength
from igaussian_core.sphere import sphere_of
from igaussian_core.views import look_at

Array = NDArray[np.float64]
Draw = Callable[[np.random.Generator], Array]  # a T_scene_cam

_CHANGE = parse_change("paper")
_HELD_OUT = 2_000_000  # seeds that no training used
_KEYPOINTS = 1024
_SHORT = 0.01  # of the depth: a relative error of less says nothing


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--map", action="append", default=[], type=Path)
    parser.add_argument("--pairs", type=int, default=60, help="of each map; 0: leave the table out")
    parser.add_argument("--procedural", type=int, default=3, help="rooms, and as many objects")
    parser.add_argument("--each", type=int, default=12, help="targets a bin; 0: no table")
    parser.add_argument("--solvers", default="paper/vit,paper/depth,pnp/depth", help="of these")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    report = {
        "facts": facts(),
        "length": lengths(arguments) if arguments.pairs else {},
        "solver": solvers(arguments) if arguments.each else {},
    }
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=1))


# ---------------------------------------------------------------- the length alone
def lengths(arguments: argparse.Namespace) -> dict[str, dict[str, float]]:
    """Errors by map, printed as a table."""
    print("| map | pairs | no relative pose | depth | network | constant |")
    print("|---|---|---|---|---|---|")
    rows = {}
    for name, scenes in _scenes(arguments):
        count = max(1, arguments.pairs // len(scenes))
        parts = [_errors(*scene, count, seed) for seed, scene in enumerate(scenes)]
        depth, network, true = (np.concatenate(column) for column in zip(*parts, strict=True))
        solved = np.isfinite(depth)
        typical = float(np.exp(np.median(np.log(true))))
        rows[name] = {
            "pairs": len(true), "unsolved": int((~solved).sum()),
            "depth": _median(depth[solved]), "network": _median(network),
            "constant": _median(typical / true - 1),
        }  # fmt: skip
        row = rows[name]
        print(
            f"| {name} | {row['pairs']} | {row['unsolved']} | {row['depth']:.1%} |"
            f" {row['network']:.1%} | {row['constant']:.1%} |", flush=True,
        )  # fmt: skip
    return rows


def _median(errors: Array) -> float:
    return float(np.median(np.abs(errors)))


Scene = tuple[GaussianMap, Camera, Draw]


def _scenes(arguments: argparse.Namespace) -> Iterator[tuple[str, list[Scene]]]:
    """Maps of one row each: the procedural ones together, then each compiled map."""
    for name, make in (("procedural rooms", make_room), ("procedural objects", make_object)):
        made = [make(_HELD_OUT + seed) for seed in range(arguments.procedural)]
        camera = Camera(480, 360, 400.0, 400.0, 239.5, 179.5)
        if made:
            yield name, [(m.gmap, camera, _places(m)) for m in made]
    for path in arguments.map:
        package = open_package(path)
        known = package.landmarks.T_scene_cam
        camera = camera_of(package).undistorted().scaled_to_fit(640)
        yield path.stem, [(package.gaussians, camera, lambda rng, k=known: rng.choice(k))]


def _places(made) -> Draw:  # type: ignore[no-untyped-def]
    def draw(rng: np.random.Generator) -> Array:
        if made.free is None:
            direction = rng.normal(size=3)
            return look_at(made.radius * direction / np.linalg.norm(direction), made.centre)
        place = made.free_positions(rng, 1)[0]
        return look_at(place, place + [*rng.normal(size=2), rng.normal(0, 0.2)])

    return draw


def _errors(
    gmap: GaussianMap, camera: Camera, draw: Draw, count: int, seed: int
) -> tuple[Array, Array, Array]:
    """Relative errors by depth (NaN without a relative pose) and by the network, and the true
    lengths over the median depth."""
    rng, matcher, learned = np.random.default_rng(seed), XFeatMatcher(), LearnedLength()
    rows: list[tuple[float, float, float]] = []
    while len(rows) < count:
        T_true = draw(rng)
        rgb, depth, alpha = gmap.render(camera, inverse(T_true))
        image = _CHANGE.apply(to_u8(rgb), int(rng.integers(2**31)))
        if (alpha > 0.8).mean() < 0.1:
            continue
        median = float(np.median(depth[alpha > 0.8]))
        T_coarse = T_true @ _offset(rng, median)
        rgb, depth, alpha = gmap.render(camera, inverse(T_coarse))
        covered = alpha > 0.8
        _, true = pose_error(T_coarse, T_true)
        if covered.mean() < 0.1 or true < _SHORT * median:
            continue
        render = to_u8(rgb)
        by_depth = _by_depth(matcher, camera, render, image, depth, alpha)
        by_network = learned(camera, render, depth, covered, image)
        rows.append((by_depth / true - 1, by_network / true - 1, true / median))
    depth_error, network_error, length = np.array(rows).T
    return depth_error, network_error, length


def _offset(rng: np.random.Generator, depth: float) -> Array:
    axis, direction = rng.normal(size=(2, 3))
    turn = np.radians(10) * rng.random() * axis / np.linalg.norm(axis)
    move = 0.15 * depth * rng.random() * direction / np.linalg.norm(direction)
    return compose(rotation_from_vector(turn), move)


def _by_depth(
    matcher: XFeatMatcher, camera: Camera, render: NDArray[np.uint8], image: NDArray[np.uint8],
    depth: NDArray[np.float32], alpha: NDArray[np.float32],
) -> float:  # fmt: skip
    a, b = matcher.extract(render, _KEYPOINTS), matcher.extract(image, _KEYPOINTS)
    pairs = matcher.match(a, b)
    uv_a, uv_b = a.uv[pairs[:, 0]], b.uv[pairs[:, 1]]
    known = at_pixels(trusted_depth(depth, alpha, 0.8, 0.1), uv_a)
    uv_a, uv_b = uv_a[known], uv_b[known]
    pose = relative_pose(camera, uv_a, uv_b, 1.0)
    if pose is None or pose.rotation_only:
        return float("nan")
    keep = pose.inliers
    z = sample(depth, uv_a[keep]).astype(np.float64)
    return depth_scale(pose, bearings(camera, uv_a[keep]), bearings(camera, uv_b[keep]), z)


# ---------------------------------------------------------------- the whole pipeline
def solvers(arguments: argparse.Namespace) -> dict[str, dict[str, dict[str, float]]]:
    """Success and medians by map and solver, printed as a table."""
    print("\n| map | solver, scale | targets | accepted | < 5 deg, 5 cm | median deg | median cm |")
    print("|---|---|---|---|---|---|---|")
    result: dict[str, dict[str, dict[str, float]]] = {}
    for path in arguments.map:
        package = open_package(path)
        sphere, camera = sphere_of(package), camera_of(package).undistorted()
        usable = shows_enough(package.gaussians, camera) if sphere.kind == "scene" else _any
        red, green, blue = package.manifest.background
        queries = RenderedQueries(
            tuple(targets(sphere, arguments.each, usable=usable)), package.gaussians, camera,
            (red, green, blue), package.T_map_scene, (_CHANGE,),
        )  # fmt: skip
        result[path.stem] = {}
        for solver, scale in (row.split("/") for row in arguments.solvers.split(",")):
            config = Config.from_flat({
                "refine.solver": solver, "refine.scale": scale, "runtime.budget_ms": 60000.0,
                "runtime.threads": arguments.threads,
            })  # fmt: skip
            name = f"{solver}, {scale}" if solver == "paper" else solver
            row = _run(Localizer(package, config), queries)
            result[path.stem][name] = row
            print(
                f"| {path.stem} | {name} | {len(queries)} | {row['accepted']:.0%} |"
                f" {row['success']:.0%} | {row['deg']:.3f} | {row['cm']:.2f} |", flush=True,
            )  # fmt: skip
    return result


def _any(T_scene_cam: Array) -> bool:
    return True


def _run(localizer: Localizer, queries: RenderedQueries) -> dict[str, float]:
    """Shares of all targets, medians over those with a pose."""
    errors, accepted = [], 0
    for index in range(len(queries)):
        image, camera = queries.image(index)
        result = localizer.localize(image, camera)
        accepted += result.ok
        if result.ok:
            errors.append(pose_error(result.T_map_cam, queries.truth(index)))
    angle, distance = np.array(errors or [(np.nan, np.nan)]).T
    return {
        "accepted": accepted / len(queries),
        "success": float(((angle < 5) & (distance < 0.05)).sum() / len(queries)),
        "deg": float(np.median(angle)), "cm": float(100 * np.median(distance)),
    }  # fmt: skip


if __name__ == "__main__":
    main()
