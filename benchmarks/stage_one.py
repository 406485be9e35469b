"""Stage one alone: what the pose network reaches on each map, and what each of its parts adds.

    python benchmarks/stage_one.py [--json out.json] [--short-steps 300] [--work folder]
                                   [--only maps|ablation|views] [--maps lego,...] [--heads]

`maps`: per map the shipped joint weights without training, the network trained on the map for its
memory from those, with --heads that trained for the paper's heads, and the landmarks, on the
paper's protocol (300 rendered targets) and on held-out photos. `ablation` (the paper's table 4,
stage one) and `views` (figure 5): lego, from random weights with --short-steps each, so that only
the part in question differs. Networks predict by their heads ("heads": candidates and weights of
the source views) and by the memory of views of known pose; of `maps` in one pass, and corrected by
what they say of one and of two renders. A trained network is kept in --work, so that an
interrupted benchmark goes on. Needs the data folder (_data.py).
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from _data import data_folder
from _facts import facts
from _maps import DEMO_ROOM, STAGE_ONE, compiled, network_file
from safetensors.numpy import save_file

from igaussian_core.coarse.attention import PAPER, PLAIN, NetworkConfig, PoseNetwork
from igaussian_core.coarse.network import MapNetwork, load_checkpoint, shipped_checkpoint
from igaussian_core.compile_map import training_images
from igaussian_core.config import Config
from igaussian_core.evaluate.coarse_estimator import CoarseOnly
from igaussian_core.evaluate.image_changes import parse_change
from igaussian_core.evaluate.metrics import by_group, plain, summarize
from igaussian_core.evaluate.photos import PhotoQueries, extent, held_out_images
from igaussian_core.evaluate.rendered import RenderedQueries, camera_of, shows_enough, targets
from igaussian_core.evaluate.runner import Queries, run
from igaussian_core.map_package import MapPackage, NetworkData, read_tensors
from igaussian_core.sphere import sphere_of
from igaussian_core.training.episodes import EpisodeOptions
from igaussian_core.training.map_network import (
    BANK,
    FOR_HEADS,
    FOR_HEADS_FROM_WEIGHTS,
    FOR_MEMORY,
    MEMORY,
    setting_of,
    train_map_network,
    train_on,
    training_map,
)
from igaussian_core.training.pose_network import TrainingMap, TrainOptions

MAPS = ("lego", DEMO_ROOM, "redkitchen", "fox", "flower")
VIEW_COUNTS = (8, 12, 16, 20)
SHORT_MEMORY = 4000
TRAININGS: tuple[tuple[str, str, EpisodeOptions | TrainOptions], ...] = (
    ("joint weights, map never seen", "untrained", dataclasses.replace(FOR_MEMORY, steps=0)),
    ("trained on the map for the memory", "memory", FOR_MEMORY),
    ("trained on the map for the paper's heads", "heads", FOR_HEADS_FROM_WEIGHTS),
)
ABLATION = {
    "plain regression (one source view, nothing asked)": (PLAIN, 1),
    "concatenation with 16 source views, plain mean": (PLAIN, 16),
    "the paper's form, plain mean": (dataclasses.replace(PAPER, weights=False), 16),
    "the paper's form: attention over views + WPM": (PAPER, 16),
    "the same with a direct path": (dataclasses.replace(PAPER, direct=True), 16),
    "attention over cells, plain mean": (NetworkConfig(lookup=False, weights=False), 16),
    "attention over cells + WPM": (NetworkConfig(lookup=False), 16),
    "attention over cells and source views + WPM (default)": (NetworkConfig(), 16),
    "the same with one source view": (NetworkConfig(), 1),
}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="where to write all figures")
    parser.add_argument("--work", type=Path, default=STAGE_ONE)
    parser.add_argument("--short-steps", type=int, default=300)
    parser.add_argument("--targets", type=int, default=100, help="in each of three bins")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--only", choices=("maps", "ablation", "views"))
    parser.add_argument("--maps", default=",".join(MAPS), help="of the first table")
    parser.add_argument("--heads", action="store_true", help="train the paper's heads as well")
    options = parser.parse_args()
    options.work.mkdir(parents=True, exist_ok=True)
    tables = {"maps": maps_table, "ablation": ablation_table, "views": views_table}
    report: dict[str, Any] = {"facts": facts()}
    report["facts"]["training"] = (
        f"from the joint weights, {FOR_MEMORY.steps} steps of {FOR_MEMORY.episodes} times "
        f"{FOR_MEMORY.views} views for the memory, {FOR_HEADS_FROM_WEIGHTS.steps} of "
        f"{FOR_HEADS_FROM_WEIGHTS.batch} for the heads; ablation and views {options.short_steps} "
        f"steps from random weights, {SHORT_MEMORY} remembered"
    )
    report["facts"]["queries"] = f"{options.targets} rendered targets a bin, held-out photos"
    for name, make in tables.items():
        if options.only in (None, name):
            report[name] = make(options)
            if options.json:
                options.json.write_text(json.dumps(report, indent=1) + "\n")


def maps_table(options: argparse.Namespace) -> list[dict[str, Any]]:
    rows = []
    for name in options.maps.split(","):
        package = compiled(options.work, name)
        for label, file, training in TRAININGS:
            if file == "heads" and not options.heads:
                continue
            trained = _trained(
                package, load_checkpoint(shipped_checkpoint()), training, 16, MEMORY,
                network_file(name, file, options.work), options.threads,
            )  # fmt: skip
            rows += _judged(package, name, label, trained, options, (0, 1, 2))
        rows += _judged(package, name, "landmarks (no training)", None, options)
    return rows


def ablation_table(options: argparse.Namespace) -> list[dict[str, Any]]:
    return _short_trainings(
        [(label, config, sources) for label, (config, sources) in ABLATION.items()], options
    )


def views_table(options: argparse.Namespace) -> list[dict[str, Any]]:
    parts = [(f"{n} source views", NetworkConfig(), n) for n in VIEW_COUNTS]
    return _short_trainings(parts, options)


def _short_trainings(
    parts: list[tuple[str, NetworkConfig, int]], options: argparse.Namespace
) -> list[dict[str, Any]]:
    """Of lego, each of a label, what the network is made of, and so many source views.

    All learn from the same views, rendered once and not renewed.
    """
    package, rows = compiled(options.work, "lego"), []
    steps = dataclasses.replace(FOR_HEADS, steps=options.short_steps, refresh=0)
    views: TrainingMap | None = None
    for label, config, sources in parts:
        made_of = hashlib.sha256(repr((config, sources, steps)).encode()).hexdigest()[:8]
        file = options.work / f"short-{made_of}.safetensors"
        if not file.is_file():
            setting = setting_of(package, sources, options.threads)
            if views is None:
                views = training_map("lego", setting, BANK, steps.seed)
            shown, _ = setting.renderer.render(setting.source_poses)
            torch.manual_seed(0)
            began = time.perf_counter()
            trained, _ = train_on(
                views._replace(sources=shown), setting, PoseNetwork(config), steps, SHORT_MEMORY,
                options.threads,
            )  # fmt: skip
            _keep(trained, file, time.perf_counter() - began, steps.steps)
        rows += _judged(package, "lego", label, read_tensors(file), options)
    return rows


def _trained(
    package: MapPackage, start: PoseNetwork, options: EpisodeOptions | TrainOptions, sources: int,
    memory: int, file: Path, threads: int,
) -> NetworkData:  # fmt: skip
    """A network trained on a map; from `file` where it is there."""
    if not file.is_file():
        began = time.perf_counter()
        trained, _ = train_map_network(
            package, start, options, sources=sources, memory=memory, threads=threads,
        )  # fmt: skip
        _keep(trained, file, time.perf_counter() - began, options.steps)
    return read_tensors(file)


def _keep(trained: MapNetwork, file: Path, seconds: float, steps: int) -> None:
    data = trained.data()
    facts = {"seconds": str(seconds), "steps": str(steps)}
    save_file(data.tensors, str(file), {**data.meta, **facts})


def _judged(
    package: MapPackage, name: str, method: str, network: NetworkData | None,
    options: argparse.Namespace, corrections: tuple[int, ...] = (0,),
) -> list[dict[str, Any]]:  # fmt: skip
    """Rows of a network's heads and of its memory, corrected by so many renders, or one of the
    landmarks."""
    rows = []
    trained = network is not None and _report(network).get("heads")
    asked = [("memory", count) for count in corrections] if network else [("", 0)]
    if trained:
        asked.insert(0, ("attention", 0))
    for head, renders in asked:
        config = Config.from_flat(
            {"coarse.method": "network", "coarse.network_head": head,
             "coarse.network_renders": renders} if network
            else {"coarse.method": "landmarks"}
        )  # fmt: skip
        estimator = CoarseOnly(dataclasses.replace(package, network=network), config)
        row: dict[str, Any] = {"case": name, "method": method, "head": head, "renders": renders}
        if network:
            row |= {"train_s": float(network.meta["seconds"]), "steps": int(network.meta["steps"])}
        row["rendered"], row["groups"] = _figures(estimator, _rendered(package, options.targets))
        if name != DEMO_ROOM:
            queries, row["extent"] = _photos(package, name)
            row["photos"], _ = _figures(estimator, queries)
        print(name, method, head, renders, json.dumps(
            {k: _short(v) for k, v in row.items() if isinstance(v, dict)}), flush=True
        )  # fmt: skip
        rows.append(row)
    return rows


def _report(network: NetworkData) -> dict[str, Any]:
    report: dict[str, Any] = json.loads(network.meta["network"])["report"]
    return report


def _figures(estimator: CoarseOnly, queries: Queries) -> tuple[dict[str, Any], dict[str, Any]]:
    outcomes = run(lambda: estimator, queries).outcomes
    groups = by_group(outcomes)
    keys = ("queries", "median_deg", "median_distance", "p90_deg", "within_15_deg", "median_ms")

    def kept(figures: Any) -> dict[str, Any]:
        return {k: v for k, v in plain(summarize(figures, 15.0, np.inf)).items() if k in keys}

    return kept(outcomes), {k: kept(v) for k, v in groups.items()}


def _short(figures: dict[str, Any]) -> Any:
    return [figures.get(k) for k in ("median_deg", "median_distance", "within_15_deg")]


def _rendered(package: MapPackage, each: int) -> RenderedQueries:
    sphere, camera = sphere_of(package), camera_of(package)
    usable = [shows_enough(package.gaussians, camera)] if sphere.kind == "scene" else []
    red, green, blue = package.manifest.background
    return RenderedQueries(
        tuple(targets(sphere, each, 0.2, 0, *usable)), package.gaussians, camera,
        (red, green, blue), package.T_map_scene, (parse_change("paper"),),
    )  # fmt: skip


def _photos(package: MapPackage, name: str) -> tuple[PhotoQueries, float]:
    folder = data_folder() / "sets" / name
    images = held_out_images(folder / "poses.json", None)
    if name == "lego":
        images = [image for image in images if image.name.startswith("test")]
    red, green, blue = package.manifest.background
    size = extent(training_images(folder / "map.ply", folder / "poses.json"))
    return PhotoQueries(tuple(images), package.T_map_scene, (red, green, blue)), size


if __name__ == "__main__":
    main()
