"""`igaussian eval`: accuracy against known poses; two tracks that are never mixed, and bags."""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.table import Table

from igaussian_core.cli_tools import (
    ConfigOption,
    MapOption,
    SetOption,
    Stages,
    console,
    direction,
    load_config,
    numbers,
    progress_bars,
)
from igaussian_core.errors import ConfigError

eval_app = typer.Typer(help="Measure accuracy against known poses.", no_args_is_help=True)

JsonOption = Annotated[Path | None, typer.Option("--json", help="write everything here")]
CsvOption = Annotated[Path | None, typer.Option("--csv", help="write one line a query here")]
ReportOption = Annotated[
    Path | None, typer.Option("--report", help="write one HTML page with plots and cases here")
]
TumOption = Annotated[
    Path | None, typer.Option("--tum", help="write accepted poses as a TUM trajectory here")
]
ResultsOption = Annotated[
    Path | None,
    typer.Option("--results", help="write accepted poses here: name qw qx qy qz tx ty tz"),
]
ChangeOption = Annotated[
    list[str] | None,
    typer.Option("--change", help="of the images: paper, gain=, gamma=, jpeg=, blur=, noise="),
]
StageOneOption = Annotated[
    bool, typer.Option("--stage-one", help="judge stage one alone: its first hypothesis")
]
JobsOption = Annotated[
    int, typer.Option(help="processes of one thread each; timings then mean little", min=1, max=64)
]


@eval_app.command("rendered")
def eval_rendered(
    map_path: MapOption,
    against: Annotated[
        Path | None,
        typer.Option(help="render the targets from this map of the same scene and frame"),
    ] = None,
    targets: Annotated[int, typer.Option(help="in each angular bin", min=1)] = 100,
    translation: Annotated[
        float, typer.Option(help="largest offset along an axis, map units", min=0)
    ] = 0.2,
    rotation_only: Annotated[
        bool, typer.Option(help="the pure-rotation test: no offset; success by rotation alone")
    ] = False,
    radius: Annotated[
        float | None, typer.Option(help="of the source poses, map units", min=1e-6)
    ] = None,
    centre: Annotated[
        str | None, typer.Option(help="of the source poses in the scene: x,y,z")
    ] = None,
    up: Annotated[str | None, typer.Option(help="up direction in the scene: x,y,z")] = None,
    change: ChangeOption = None,
    exact_colours: Annotated[
        bool, typer.Option(help="leave out the paper's colour and brightness changes")
    ] = False,
    seed: Annotated[int, typer.Option(help="of the random targets")] = 0,
    max_deg: Annotated[float, typer.Option(help="success: rotation error below", min=1e-9)] = 5.0,
    max_distance: Annotated[
        float, typer.Option(help="success: position error below, map units", min=1e-9)
    ] = 0.05,
    stage_one: StageOneOption = False,
    jobs: JobsOption = 1,
    json_out: JsonOption = None,
    csv_out: CsvOption = None,
    report: ReportOption = None,
    tum: TumOption = None,
    results: ResultsOption = None,
    config: ConfigOption = None,
    set_: SetOption = None,
) -> None:
    """The paper's protocol: targets rendered from the map, three bins of angular distance."""
    from igaussian_core.evaluate import rendered
    from igaussian_core.gaussian_map import load_map
    from igaussian_core.map_package import open_package
    from igaussian_core.sphere import sphere_of

    package = open_package(map_path)
    scale = package.T_map_scene.scale
    sphere = sphere_of(package)
    chosen: dict[str, Any] = {
        "radius": radius / scale if radius else None,
        "centre": numbers(centre, 3, "--centre"),
        "up": direction(up, "--up"),
    }
    sphere = dataclasses.replace(sphere, **{k: v for k, v in chosen.items() if v is not None})
    gmap = load_map(against) if against else package.gaussians
    camera = rendered.camera_of(package)
    drawn = rendered.targets(
        sphere, targets, 0.0 if rotation_only else translation / scale, seed,
        *([rendered.shows_enough(gmap, camera)] if sphere.kind == "scene" else []),
    )  # fmt: skip
    texts = ([] if exact_colours else ["paper"]) + (change or [])
    red, green, blue = package.manifest.background
    queries = rendered.RenderedQueries(
        tuple(drawn), gmap, camera, (red, green, blue), package.T_map_scene, _changes(texts)
    )
    facts = {
        "targets": f"{targets} in each bin, seed {seed}",
        "rendered from": str(against) if against else "the map itself",
        "translation offset": "0 (pure rotation)" if rotation_only else f"±{translation:g}",
        "sphere": f"{sphere.kind}, R = {sphere.radius * scale:.3g}, centre "
                  f"{', '.join(f'{v:.3g}' for v in sphere.centre)}",
        "image": f"{camera.width}x{camera.height}, f = {camera.fx:.1f}",
        "changes": ", ".join(texts) or "none",
    }  # fmt: skip
    # a pure rotation is judged by rotation: whatever the position
    _evaluate(
        "rendered", map_path, queries, facts, load_config(config, set_), jobs,
        (max_deg, float("inf") if rotation_only else max_distance),
        _Outputs(json_out, csv_out, report, tum, results), stage_one,
    )  # fmt: skip


@eval_app.command("photos")
def eval_photos(
    poses: Annotated[Path, typer.Argument(help="photos with poses, as for map compile --cameras")],
    map_path: MapOption,
    note: Annotated[
        Path | None, typer.Option(help="map.json that names the photos trained on")
    ] = None,
    allow_training: Annotated[
        bool, typer.Option(help="judge photos that the map was trained on, too")
    ] = False,
    subset: Annotated[str, typer.Option(help="only photos whose name starts so")] = "",
    change: ChangeOption = None,
    max_deg: Annotated[float, typer.Option(help="success: rotation error below", min=1e-9)] = 5.0,
    max_extent: Annotated[
        float, typer.Option(help="success: position error below, share of the cameras' extent")
    ] = 0.05,
    max_distance: Annotated[
        float | None, typer.Option(help="the same in map units, instead", min=1e-9)
    ] = None,
    stage_one: StageOneOption = False,
    jobs: JobsOption = 1,
    json_out: JsonOption = None,
    csv_out: CsvOption = None,
    report: ReportOption = None,
    tum: TumOption = None,
    results: ResultsOption = None,
    config: ConfigOption = None,
    set_: SetOption = None,
) -> None:
    """Localize held-out photos without a prior and compare with their poses."""
    from igaussian_core.compile_map import training_images
    from igaussian_core.evaluate.photos import PhotoQueries, extent, folder_of, held_out_images
    from igaussian_core.map_package import open_package

    images = [i for i in held_out_images(poses, note, allow_training) if i.name.startswith(subset)]
    if not images:
        raise ConfigError(f"--subset {subset}: no photo's name starts so")
    size = extent(training_images(note or folder_of(poses) / "map.ply", poses))
    package = open_package(map_path)
    red, green, blue = package.manifest.background
    queries = PhotoQueries(
        tuple(images), package.T_map_scene, (red, green, blue), _changes(change or [])
    )
    limit = max_distance or max_extent * size * package.T_map_scene.scale
    facts = {
        "photos": f"{len(images)} of {poses}"
                  + (", the map's training photos among them" if allow_training else ", held out"),
        "extent of the training cameras": f"{size:.4g}",
        "changes": ", ".join(change or []) or "none",
    }  # fmt: skip
    evaluation = _evaluate(
        "photos", map_path, queries, facts, load_config(config, set_), jobs, (max_deg, limit),
        _Outputs(json_out, csv_out, report, tum, results), stage_one,
    )  # fmt: skip
    for o in evaluation.outcomes:
        if not (o.angle_deg < max_deg and o.distance < limit):
            console.print(f"  {o.name}: {o.status}, {o.angle_deg:.2f} deg, {o.distance:.3g}")


@eval_app.command("bag")
def eval_bag(
    bag: Annotated[Path, typer.Argument(help=".mcap, rosbag2 directory or ROS 1 .bag")],
    map_path: MapOption,
    truth: Annotated[str | None, typer.Option(help="topic of the true camera poses")] = None,
    rate: Annotated[float, typer.Option(help="2 plays twice as fast", min=0.01)] = 1.0,
    duration: Annotated[
        float | None, typer.Option(help="seconds of the recording", min=0.1)
    ] = None,
    every_frame: Annotated[
        bool, typer.Option(help="process every frame, however long it takes")
    ] = False,
    image_topic: Annotated[str | None, typer.Option(help="default: found")] = None,
    camera_info_topic: Annotated[str | None, typer.Option(help="default: found")] = None,
    json_out: JsonOption = None,
    report: ReportOption = None,
    tum: TumOption = None,
    config: ConfigOption = None,
    set_: SetOption = None,
) -> None:
    """Localize a recording frame after frame: ATE, RPE, latency, dropped images."""
    from igaussian_core.bags import Bag
    from igaussian_core.evaluate.drive import Trajectory, summarize_drive
    from igaussian_core.evaluate.drive_overlays import make_overlays
    from igaussian_core.evaluate.drive_report import Drive, drive_page
    from igaussian_core.evaluate.drive_run import run_drive
    from igaussian_core.evaluate.metrics import plain
    from igaussian_core.evaluate.report import machine_facts, write_text
    from igaussian_core.evaluate.trajectory_errors import trajectory_errors
    from igaussian_core.map_package import open_package
    from igaussian_core.tum import write_tum

    configuration = load_config(config, set_)
    localizer = _open_warm(map_path, configuration)
    topics = (image_topic, camera_info_topic)
    with Bag(bag) as recording, progress_bars() as progress:
        true = Trajectory(recording.poses(truth))
        images = recording.topics[image_topic or recording.image_topic()].count
        stages = Stages(progress)
        seen: list[Any] = []

        def show(frame: Any) -> None:
            seen.append(frame)
            stages("frames", len(seen), images)

        run = run_drive(
            recording, localizer, configuration, true, rate, duration, every_frame, show, topics
        )
    judged = [
        (f.T_map_cam, f.T_map_cam_true, f.stamp_ns * 1e-9)
        for f in run.frames
        if f.T_map_cam is not None and f.T_map_cam_true is not None
    ]
    figures = {
        **summarize_drive(run.frames, len(run.frames) + run.dropped, run.memory),
        "dropped": float(run.dropped),
        **trajectory_errors(judged),
    }
    table = Table(title=f"{bag}: {len(judged)} poses judged", show_header=False)
    for name, value in figures.items():
        table.add_row(name, f"{value:.4g}")
    console.print(table)
    facts = {
        "recording": str(bag), "map": str(map_path), "replay rate": f"{rate:g}",
        "every frame": str(every_frame), **machine_facts(),
    }  # fmt: skip
    if json_out is not None:
        document = {
            "track": "bag", "facts": facts, "summary": plain(figures),
            "config": dataclasses.asdict(configuration),
        }  # fmt: skip
        write_text(json_out, json.dumps(document, indent=1) + "\n")
    if tum is not None:
        write_tum(
            tum, ((f.stamp_ns * 1e-9, f.T_map_cam) for f in run.frames if f.T_map_cam is not None)
        )
    if report is not None:
        with Bag(bag) as recording:
            overlays = make_overlays(recording, localizer, run.frames, 6, topics=topics)
        package = open_package(map_path)
        points = package.T_map_scene.points(package.gaussians.means).astype(np.float32)
        drive = Drive(
            f"iGaussian: {bag.name}", figures, run.frames, true, run.memory, points, overlays, {},
            facts,
        )  # fmt: skip
        write_text(report, drive_page(drive))
        console.print(f"report: {report}")


@dataclasses.dataclass(frozen=True)
class _Outputs:
    """Files to write, None where not wanted."""

    json: Path | None
    csv: Path | None
    report: Path | None
    tum: Path | None
    results: Path | None

    def partial(self) -> Path | None:
        """Where an unfinished run is kept: beside the first file that was asked for."""
        wanted = (getattr(self, field.name) for field in dataclasses.fields(self))
        first = next((path for path in wanted if path is not None), None)
        return first.with_name(first.name + ".partial.jsonl") if first else None


def _changes(texts: Sequence[str]) -> Any:
    from igaussian_core.evaluate.image_changes import parse_change

    return tuple(parse_change(text) for text in texts)


def _evaluate(
    track: str,
    map_path: Path,
    queries: Any,
    facts: dict[str, str],
    config: Any,
    jobs: int,
    limits: tuple[float, float],
    outputs: _Outputs,
    stage_one: bool = False,
) -> Any:
    """Run the queries through a localizer, or through its stage one alone; say the figures,
    write what was asked for."""
    from igaussian_core.evaluate.report import Evaluation, machine_facts
    from igaussian_core.evaluate.runner import Partial, run
    from igaussian_core.map_package import open_package

    manifest = open_package(map_path).manifest
    if jobs > 1:
        runtime = dataclasses.replace(config.runtime, threads=1)
        config = dataclasses.replace(config, runtime=runtime)
    names = [queries.name(index) for index in range(len(queries))]
    facts = facts | ({"stage": "one alone, unverified"} if stage_one else {})
    key = json.dumps([track, manifest.gaussians_sha256, facts, names, config.to_flat()])
    path = outputs.partial()
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
    partial = Partial(path, key) if path else None
    open_localizer = functools.partial(_open_warm, map_path, config)
    with progress_bars() as progress:
        stages = Stages(progress)
        opener = functools.partial(_open_coarse, map_path, config) if stage_one else open_localizer
        done = run(opener, queries, partial, jobs, lambda d, n: stages(track, d, n))
    facts = {
        "map": f"{map_path} ({manifest.kind}, {manifest.source_file})", **facts,
        "processes": str(jobs), **machine_facts(),
    }  # fmt: skip
    title = f"iGaussian: {track} track, {map_path.stem}"
    evaluation = Evaluation(
        title, track, done.outcomes, *limits, done.memory_mb, config, facts
    )
    _print_summary(evaluation)
    _write(evaluation, queries, open_localizer, outputs)
    if partial is not None:
        partial.remove()
    return evaluation


def _open_warm(map_path: Path, config: Any) -> Any:
    """A localizer whose first frame takes no longer than the others."""
    from igaussian_core.localizer import Localizer

    localizer = Localizer.open(map_path, config)
    localizer.warm_up()
    return localizer


def _open_coarse(map_path: Path, config: Any) -> Any:
    from igaussian_core.evaluate.coarse_estimator import CoarseOnly
    from igaussian_core.map_package import open_package

    return CoarseOnly(open_package(map_path), config)


def _write(evaluation: Any, queries: Any, open_localizer: Any, outputs: _Outputs) -> None:
    from igaussian_core.evaluate import report
    from igaussian_core.tum import write_tum, write_visual_localization

    accepted = [(i, o) for i, o in enumerate(evaluation.outcomes) if o.T_map_cam is not None]
    if outputs.json is not None:
        report.write_json(evaluation, outputs.json)
    if outputs.csv is not None:
        report.write_csv(evaluation, outputs.csv)
    if outputs.tum is not None:
        write_tum(outputs.tum, ((float(i), o.T_map_cam) for i, o in accepted))
    if outputs.results is not None:
        # the benchmark wants names without folders; kept where they tell images apart
        short = {Path(o.name).name for o in evaluation.outcomes}
        whole = len(short) < len(evaluation.outcomes)
        named = ((o.name if whole else Path(o.name).name, o.T_map_cam) for _, o in accepted)
        write_visual_localization(outputs.results, named)
    if outputs.report is not None:
        report.write_html(evaluation, queries, open_localizer(), outputs.report)
        console.print(f"report: {outputs.report}")


def _print_summary(evaluation: Any) -> None:
    summary, groups = evaluation.summary(), evaluation.groups()
    table = Table(title=f"{evaluation.title}, success {evaluation.limit_text()}")
    table.add_column("figure")
    for name in ["all", *groups]:
        table.add_column(name, justify="right")
    for key in summary:
        columns = [summary, *groups.values()]
        table.add_row(key, *(f"{s[key]:.4g}" if key in s else "" for s in columns))
    console.print(table)
