"""The command `igaussian`."""

from __future__ import annotations

import dataclasses
import json
import logging
import sys
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer
from rich.console import Console
from rich.logging import RichHandler
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from igaussian_core import __version__
from igaussian_core.errors import ConfigError, IGaussianError

app = typer.Typer(help=__doc__, no_args_is_help=True, pretty_exceptions_enable=False)
map_app = typer.Typer(help="Compile, inspect and align maps.", no_args_is_help=True)
eval_app = typer.Typer(help="Measure accuracy against known poses.", no_args_is_help=True)
app.add_typer(map_app, name="map")
app.add_typer(eval_app, name="eval")
console = Console()

MapOption = Annotated[Path, typer.Option("--map", help="compiled map directory (.igmap)")]
ConfigOption = Annotated[
    Path | None, typer.Option("--config", help="JSON file of configuration groups")
]
SetOption = Annotated[
    list[str] | None, typer.Option("--set", help="one value, e.g. refine.rounds=2; repeatable")
]


def main() -> None:
    """Entry point: a known error is one line on stderr and exit code 1."""
    logging.basicConfig(
        level=logging.WARNING, format="%(message)s",
        handlers=[RichHandler(console=Console(stderr=True), show_time=False, show_path=False)],
    )  # fmt: skip
    try:
        app()
    except IGaussianError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(1)


def _version(value: bool) -> None:
    if value:
        print(f"igaussian {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="print the version")
    ] = False,
) -> None:
    pass


def load_config(file: Path | None, settings: list[str] | None) -> Any:
    """Config of a file and of `group.key=value` settings, which win."""
    from igaussian_core.config import Config

    flat = Config.from_file(file).to_flat() if file else {}
    for setting in settings or []:
        name, separator, text = setting.partition("=")
        if not separator:
            raise ConfigError(f"--set {setting}: expected group.key=value")
        try:
            flat[name] = json.loads(text)
        except ValueError:
            flat[name] = text
    return Config.from_flat(flat)


def _progress() -> Progress:
    return Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
        console=console,
    )  # fmt: skip


class _Stages:
    """Shows one progress bar for each stage as it reports itself."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._tasks: dict[str, Any] = {}

    def __call__(self, stage: str, done: int, of: int) -> None:
        if stage not in self._tasks:
            self._tasks[stage] = self._progress.add_task(stage, total=of)
        self._progress.update(self._tasks[stage], completed=done, total=of)


def _numbers(text: str | None, count: int, name: str) -> tuple[float, ...] | None:
    if text is None:
        return None
    try:
        values = tuple(float(part) for part in text.replace(",", " ").split())
    except ValueError as error:
        raise ConfigError(f"{name} '{text}': expected {count} numbers") from error
    if len(values) != count:
        raise ConfigError(f"{name} '{text}': expected {count} numbers, got {len(values)}")
    return values


@map_app.command("compile")
def map_compile(
    source: Annotated[Path, typer.Argument(help="Gaussian map, .ply")],
    output: Annotated[Path, typer.Option("-o", "--output", help="compiled map directory")],
    cameras: Annotated[
        Path | None,
        typer.Option(help="training cameras: poses.json, transforms.json, cameras.json, COLMAP"),
    ] = None,
    kind: Annotated[str | None, typer.Option(help="object or scene")] = None,
    radius: Annotated[
        float | None, typer.Option(help="radius of the spherical views, scene units")
    ] = None,
    up: Annotated[str | None, typer.Option(help="up direction in the scene: x,y,z")] = None,
    views: Annotated[int, typer.Option(help="most source views", min=1, max=2000)] = 120,
    config: ConfigOption = None,
    set_: SetOption = None,
) -> None:
    """Compile a Gaussian map: place source views, render them, lift their keypoints to 3D."""
    from igaussian_core.compile_map import CompileOptions, compile_map

    options = CompileOptions(
        kind=kind, radius=radius, up=_numbers(up, 3, "--up"), views=views  # type: ignore[arg-type]
    )
    with _progress() as progress:
        package = compile_map(
            source, output, cameras, options, load_config(config, set_), _Stages(progress)
        )
    landmarks = package.landmarks
    console.print(
        f"{output}: {package.manifest.kind}, {len(package.gaussians):,} Gaussians, "
        f"{landmarks.view_count} source views, {len(landmarks.points):,} landmarks, "
        f"{_folder_megabytes(output):.1f} MB"
    )


@map_app.command("info")
def map_info(path: Annotated[Path, typer.Argument(help=".igmap directory or .ply")]) -> None:
    """Say what a compiled map or a Gaussian file holds."""
    table = Table(show_header=False, title=str(path))
    for key, value in _describe(path).items():
        table.add_row(key, value)
    console.print(table)


def _describe(path: Path) -> dict[str, str]:
    from igaussian_core.gaussian_map import load_map
    from igaussian_core.map_package import open_package

    if path.is_dir():
        package = open_package(path)
        m, gmap = package.manifest, package.gaussians
        rows = {
            "compiled from": m.source_file,
            "kind": m.kind,
            "radius": f"{m.radius:.3g}",
            "source views": str(package.landmarks.view_count),
            "landmarks": f"{len(package.landmarks.points):,} ({m.matcher})",
            "scale, map / scene": f"{package.T_map_scene.scale:.6g}",
            "size on disk": f"{_folder_megabytes(path):.1f} MB",
        }
    else:
        gmap, rows = load_map(path), {}
    rows |= {
        "Gaussians": f"{len(gmap):,}",
        "left out on loading": str(gmap.dropped),
        "SH degree": str(gmap.sh_degree),
        "antialiased": "yes" if gmap.antialiased else "no",
    }
    if len(gmap):
        low, high = gmap.bounds()
        p5, p50, p95 = np.percentile(gmap.scales.max(axis=1), [5, 50, 95])
        rows["bounds (98 %)"] = f"{np.round(low, 3).tolist()} to {np.round(high, 3).tolist()}"
        rows["largest scale p5, p50, p95"] = f"{p5:.4g}, {p50:.4g}, {p95:.4g}"
        rows["opacity below 0.05"] = f"{float((gmap.opacities < 0.05).mean()):.1%}"
    return rows


@map_app.command("align")
def map_align(
    path: Annotated[Path, typer.Argument(help="compiled map directory")],
    scale: Annotated[float, typer.Option(help="metres a scene unit")] = 1.0,
    up: Annotated[str | None, typer.Option(help="the scene's up direction: x,y,z")] = None,
    origin: Annotated[
        str | None, typer.Option(help="scene point that becomes the map's origin: x,y,z")
    ] = None,
    matrix: Annotated[
        Path | None, typer.Option(help="JSON file with a 4x4 similarity T_map_scene")
    ] = None,
) -> None:
    """Say where the map frame lies: metric scale, up axis, origin, or a whole similarity."""
    from igaussian_core.geometry import Sim3
    from igaussian_core.map_package import with_T_map_scene
    from igaussian_core.views import up_rotation

    if matrix is not None:
        try:
            T_map_scene = Sim3.from_matrix(json.loads(matrix.read_text()))
        except (OSError, ValueError) as error:
            raise ConfigError(f"{matrix}: {error}") from error
    else:
        if not (np.isfinite(scale) and scale > 0):
            raise ConfigError(f"--scale {scale}: must be positive")
        axis, point = _numbers(up, 3, "--up"), _numbers(origin, 3, "--origin")
        rotation = up_rotation(np.array(axis)).T if axis else np.eye(3)
        T_map_scene = Sim3(scale, rotation, -scale * rotation @ np.array(point or (0.0,) * 3))
    manifest = with_T_map_scene(path, T_map_scene)
    console.print(f"{path}: T_map_scene = {json.dumps(manifest.T_map_scene)}")


def _folder_megabytes(path: Path) -> float:
    return sum(f.stat().st_size for f in path.rglob("*") if f.is_file()) / 1e6


FxOption = Annotated[float | None, typer.Option(help="focal length in pixels")]


@app.command()
def render(
    source: Annotated[Path, typer.Argument(help=".ply or compiled map")],
    output: Annotated[Path, typer.Option("-o", "--output", help="picture to write")],
    camera: Annotated[
        Path, typer.Option(help="camera poses: poses.json, transforms.json, cameras.json, COLMAP")
    ],
    index: Annotated[int, typer.Option(help="which of the cameras")] = 0,
    depth: Annotated[
        Path | None, typer.Option(help="write depth too: 16-bit PNG, thousandths of a unit")
    ] = None,
) -> None:
    """Render a map at one of a file's cameras."""
    from igaussian_core.gaussian_map import load_map
    from igaussian_core.geometry import inverse
    from igaussian_core.map_package import open_package
    from igaussian_core.posed_images import read_posed_images

    gmap = open_package(source).gaussians if source.is_dir() else load_map(source)
    posed = read_posed_images(camera)
    if not 0 <= index < len(posed):
        raise ConfigError(f"--index {index}: {camera} holds {len(posed)} cameras")
    view = posed[index]
    rgb, z, _ = gmap.render(view.camera.undistorted(), inverse(view.T_scene_cam))
    _write_picture(output, np.clip(rgb[..., ::-1] * 255 + 0.5, 0, 255).astype(np.uint8))
    if depth is not None:
        _write_picture(depth, np.clip(z * 1000, 0, 65535).astype(np.uint16))


def _write_picture(path: Path, image: Any) -> None:
    try:
        written = cv2.imwrite(str(path), image)
    except cv2.error:
        written = False
    if not written:
        raise ConfigError(f"{path}: cannot be written; supported: .png, .jpg in an existing folder")


@app.command()
def localize(
    photo: Annotated[Path, typer.Argument(help="image file")],
    map_path: MapOption,
    fx: Annotated[float, typer.Option(help="focal length in pixels")],
    fy: FxOption = None,
    cx: Annotated[float | None, typer.Option(help="principal point, first pixel at 0")] = None,
    cy: Annotated[float | None, typer.Option(help="principal point, first pixel at 0")] = None,
    model: Annotated[str, typer.Option(help="distortion model")] = "plumb_bob",
    dist: Annotated[str | None, typer.Option(help="distortion coefficients, by commas")] = None,
    prior: Annotated[
        str | None, typer.Option(help="T_map_cam guess: x,y,z,qw,qx,qy,qz")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="print the result as JSON")] = False,
    config: ConfigOption = None,
    set_: SetOption = None,
) -> None:
    """Where was a photo taken? Exit code 2 where that cannot be said."""
    from igaussian_core.camera import Camera
    from igaussian_core.geometry import compose, rotation_from_quaternion
    from igaussian_core.localizer import Localizer
    from igaussian_core.posed_images import read_image

    image = read_image(photo)
    height, width = image.shape[:2]
    coefficients = tuple(float(v) for v in dist.split(",")) if dist else ()
    camera = Camera(
        width, height, fx, fy or fx,
        (width - 1) / 2 if cx is None else cx, (height - 1) / 2 if cy is None else cy,
        model, coefficients,
    )  # fmt: skip
    guess = _numbers(prior, 7, "--prior")
    T_prior = compose(rotation_from_quaternion(guess[3:]), guess[:3]) if guess else None
    result = Localizer.open(map_path, load_config(config, set_)).localize(image, camera, T_prior)
    if as_json:
        print(json.dumps(result_json(result)))
    else:
        _print_result(result)
    if not result.ok:
        raise typer.Exit(2)


def result_json(result: Any) -> dict[str, Any]:
    """A LocalizationResult as plain JSON values (not-a-number becomes null)."""

    def plain(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            return value.tolist()
        if isinstance(value, float) and not np.isfinite(value):
            return None
        return value

    fields = dataclasses.fields(result)
    data = {field.name: plain(getattr(result, field.name)) for field in fields}
    return {**data, "status": result.status.value, "ok": result.ok}


def _print_result(result: Any) -> None:
    from igaussian_core.geometry import quaternion_from_rotation

    console.print(f"{result.status.value}: {result.reason}")
    if result.T_map_cam is not None:
        position = np.round(result.T_map_cam[:3, 3], 4).tolist()
        quaternion = np.round(quaternion_from_rotation(result.T_map_cam[:3, :3]), 5).tolist()
        sigma = np.sqrt(np.diag(result.covariance))
        console.print(f"position x y z    {position}  +- {np.round(sigma[:3], 4).tolist()}")
        console.print(f"rotation w x y z  {quaternion}  +- {np.round(np.degrees(sigma[3:]), 3)} deg")
    console.print({stage: round(ms, 1) for stage, ms in result.timings_ms.items()})


@app.command()
def demo(
    bag: Annotated[
        Path | None, typer.Option(help="recording with true poses; default: the bundled drive")
    ] = None,
    map_path: Annotated[
        Path | None, typer.Option("--map", help=".igmap or .ply; default: the bundled room")
    ] = None,
    cameras: Annotated[
        Path | None, typer.Option(help="training cameras of the .ply, as for map compile")
    ] = None,
    work_dir: Annotated[
        Path, typer.Option(help="compiled map, report and recording go here")
    ] = Path("out"),
    rate: Annotated[float, typer.Option(help="replay rate; latencies hold at 1", min=0.01)] = 1.0,
    duration: Annotated[
        float | None, typer.Option(help="seconds of the recording", min=0.1)
    ] = None,
    truth: Annotated[str | None, typer.Option(help="topic of the true camera poses")] = None,
    no_ros: Annotated[
        bool, typer.Option("--no-ros", help="same worker and tracker inside this process")
    ] = False,
    json_out: Annotated[Path | None, typer.Option("--json", help="write figures here")] = None,
    config: ConfigOption = None,
    set_: SetOption = None,
) -> None:
    """Localize a recorded drive through the real ROS 2 node; a live table, then a report."""
    try:
        from igaussian_ros.demo import DemoOptions, run_demo
    except ModuleNotFoundError as error:
        raise ConfigError(f"the demo needs the package igaussian_ros: {error}") from error

    options = DemoOptions(
        bag=bag, map=map_path, cameras=cameras, work_dir=work_dir, rate=rate, duration_s=duration,
        without_ros=no_ros, truth_topic=truth, config=load_config(config, set_),
    )  # fmt: skip
    run_demo(options, json_out, console)


@app.command("replay")
def replay_bag(
    bag: Annotated[Path, typer.Argument(help=".mcap, rosbag2 directory or ROS 1 .bag")],
    map_path: MapOption,
    rate: Annotated[float, typer.Option(help="2 plays twice as fast", min=0.01)] = 1.0,
    duration: Annotated[
        float | None, typer.Option(help="seconds of the recording", min=0.1)
    ] = None,
    every_frame: Annotated[
        bool, typer.Option(help="process every frame, however long it takes")
    ] = False,
    recover: Annotated[
        bool, typer.Option(help="use what is readable of a truncated recording")
    ] = False,
    image_topic: Annotated[str | None, typer.Option(help="default: found")] = None,
    camera_info_topic: Annotated[str | None, typer.Option(help="default: found")] = None,
    config: ConfigOption = None,
    set_: SetOption = None,
) -> None:
    """Localize a recording without ROS; one JSON line for each processed frame on stdout."""
    from igaussian_core.bags import Bag
    from igaussian_core.localizer import Localizer
    from igaussian_core.replay import ReplayedFrame, replay

    def show(frame: ReplayedFrame) -> None:
        line = {
            "stamp_ns": frame.frame.stamp_ns,
            "latency_ms": frame.latency_ms,
            **result_json(frame.result),
        }
        print(json.dumps(line), flush=True)

    configuration = load_config(config, set_)
    localizer = Localizer.open(map_path, configuration)
    with Bag(bag, recover) as recording:
        for problem in recording.problems:
            print(f"warning: {problem}", file=sys.stderr)
        stats = replay(
            recording, localizer, configuration, show, rate, duration, every_frame,
            topics=(image_topic, camera_info_topic),
        )  # fmt: skip
    print(f"{stats.processed} frames processed, {stats.dropped} dropped", file=sys.stderr)


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
    max_deg: Annotated[float, typer.Option(help="success: rotation error below, degrees")] = 5.0,
    max_extent: Annotated[
        float, typer.Option(help="success: position error below, share of the cameras' extent")
    ] = 0.05,
    json_out: Annotated[Path | None, typer.Option("--json", help="write results here")] = None,
    config: ConfigOption = None,
    set_: SetOption = None,
) -> None:
    """Localize held-out photos without a prior and compare with their poses."""
    from igaussian_core.compile_map import training_images
    from igaussian_core.evaluate.metrics import summarize
    from igaussian_core.evaluate.photos import evaluate_photos, extent, held_out_images
    from igaussian_core.localizer import Localizer

    configuration = load_config(config, set_)
    images = [i for i in held_out_images(poses, note, allow_training) if i.name.startswith(subset)]
    folder = poses if poses.is_dir() else poses.parent
    size = extent(training_images(note or folder / "map.ply", poses))
    localizer = Localizer.open(map_path, configuration)
    with _progress() as progress:
        stages = _Stages(progress)
        outcomes = evaluate_photos(localizer, images, lambda d, n: stages("photos", d, n))
    limit = max_extent * size * localizer.T_map_scene.scale
    summary = summarize(outcomes, max_deg, limit)
    _print_summary(f"{poses}: held-out photos, success < {max_deg:g} deg and {limit:.3g}", summary)
    for o in outcomes:
        if not (o.angle_deg < max_deg and o.distance < limit):
            console.print(f"  {o.name}: {o.status}, {o.angle_deg:.2f} deg, {o.distance:.3g}")
    if json_out is not None:
        document = {
            "summary": summary,
            "extent": size,
            "config": dataclasses.asdict(configuration),
            "queries": [dataclasses.asdict(o) for o in outcomes],
        }
        json_out.write_text(json.dumps(document, indent=1))


def _print_summary(title: str, summary: dict[str, float]) -> None:
    table = Table(title=title)
    table.add_column("figure")
    table.add_column("value", justify="right")
    for key, value in summary.items():
        table.add_row(key, f"{value:.4g}")
    console.print(table)


if __name__ == "__main__":
    main()
