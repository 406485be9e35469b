"""The command `igaussian`."""

from __future__ import annotations

import dataclasses
import json
import logging
import sys
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.logging import RichHandler
from rich.table import Table

from igaussian_core import __version__
from igaussian_core.cli_eval import eval_app
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
from igaussian_core.cli_train import network_summary, train_app, train_map
from igaussian_core.errors import ConfigError, IGaussianError, MapError

app = typer.Typer(help=__doc__, no_args_is_help=True, pretty_exceptions_enable=False)
map_app = typer.Typer(help="Compile, inspect and align maps.", no_args_is_help=True)
app.add_typer(map_app, name="map")
app.add_typer(eval_app, name="eval")
app.add_typer(train_app, name="train")

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


@map_app.command("compile")
def map_compile(
    source: Annotated[Path, typer.Argument(help="file of Gaussians: .ply, .spz, .sog, .splat")],
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
    network: Annotated[
        bool, typer.Option(help="a pose network of the shipped weights: half a minute")
    ] = True,
    train: Annotated[
        bool, typer.Option(help="train it on the map: more exact, ten minutes and more")
    ] = False,
    train_steps: Annotated[
        int | None, typer.Option(help="of that training; fewer are quicker and less exact", min=0)
    ] = None,
    config: ConfigOption = None,
    set_: SetOption = None,
) -> None:
    """Compile a Gaussian map: place source views, render them, lift their keypoints to 3D."""
    from igaussian_core.compile_map import CompileOptions, compile_map

    options = CompileOptions(
        kind=kind, radius=radius, up=direction(up, "--up"), views=views  # type: ignore[arg-type]
    )
    settings = load_config(config, set_)
    with progress_bars() as progress:
        package = compile_map(source, output, cameras, options, settings, Stages(progress))
    landmarks = package.landmarks
    console.print(
        f"{output}: {package.manifest.kind}, {len(package.gaussians):,} Gaussians, "
        f"{landmarks.view_count} source views, {len(landmarks.points):,} landmarks, "
        f"{_megabytes(output):.1f} MB"
    )
    if train:
        train_map(output, steps=train_steps, config=config, set_=set_)
    elif network:
        _add_network(output, settings.runtime.threads)


def _add_network(path: Path, threads: int) -> None:
    """An untrained pose network; a map that shows too little for one stays without."""
    from igaussian_core.training.map_network import add_untrained_network

    try:
        with progress_bars() as progress:
            report = add_untrained_network(path, threads, Stages(progress))
    except MapError as error:
        console.print(f"{path}: no pose network, landmarks alone: {error}")
        return
    console.print(f"{path}: pose network, untrained: {network_summary(report)}")


@map_app.command("views")
def map_views(
    path: Annotated[Path, typer.Argument(help="compiled map directory (.igmap)")],
    plot: Annotated[Path, typer.Option(help="picture of the camera layout")],
    count: Annotated[int, typer.Option(help="source views of the pose network", min=1)] = 16,
) -> None:
    """Draw where the source views of the pose network stand, and those of the landmarks."""
    from igaussian_core.map_package import open_package
    from igaussian_core.pictures import plot_cameras
    from igaussian_core.training.map_network import setting_of

    package = open_package(path)
    setting = setting_of(package, count)
    plot_cameras(
        plot, package.gaussians.means,
        {f"{len(setting.source_poses)} source views of the pose network": setting.source_poses,
         f"{package.landmarks.view_count} of the landmarks": package.landmarks.T_scene_cam},
        setting.sampler.length,
    )  # fmt: skip
    console.print(f"{plot}: {package.manifest.kind}, R = {setting.sampler.sphere.radius:.3g}")


@map_app.command("info")
def map_info(
    path: Annotated[Path, typer.Argument(help=".igmap directory or a file of Gaussians")],
    as_json: Annotated[bool, typer.Option("--json", help="print one JSON object")] = False,
) -> None:
    """Say what a compiled map or a Gaussian file holds."""
    rows = _describe(path)
    if as_json:
        print(json.dumps(rows))
        return
    table = Table(show_header=False, title=str(path))
    for key, value in rows.items():
        table.add_row(key, value)
    console.print(table)


def _describe(path: Path) -> dict[str, str]:
    from igaussian_core.gaussian_map import load_map
    from igaussian_core.map_package import is_package, open_package
    from igaussian_core.map_summary import summarize

    if not is_package(path):
        rows = summarize(load_map(path))
        return rows | {"size on disk": f"{_megabytes(path):.1f} MB"}
    package = open_package(path)
    m = package.manifest
    network = {}
    if package.network is not None:
        from igaussian_core.coarse.network import MapNetwork

        report = MapNetwork.from_data(package.network, str(path)).report
        network = {"pose network": network_summary(report)}
    return {
        "compiled from": m.source_file,
        "kind": m.kind,
        "radius": f"{m.radius:.3g}",
        "source views": str(package.landmarks.view_count),
        "landmarks": f"{len(package.landmarks.points):,} ({m.matcher})",
        **network,
        "scale, map / scene": f"{package.T_map_scene.scale:.6g}",
        "covariance": f"times {m.covariance_scale:.3g}, measured on {m.covariance_poses} photos"
        if m.covariance_poses else "not calibrated",
        "size on disk": f"{_megabytes(path):.1f} MB",
        **summarize(package.gaussians),
    }


@map_app.command("convert")
def map_convert(
    source: Annotated[Path, typer.Argument(help="file of Gaussians in any supported format")],
    output: Annotated[Path, typer.Option("-o", "--output", help=".ply or .spz")],
) -> None:
    """Write a file of Gaussians in another format, in the frame of a .ply."""
    from igaussian_core.gaussian_map import load_map, save_map

    gmap = load_map(source)
    save_map(gmap, output)
    console.print(
        f"{output}: {len(gmap):,} Gaussians, {_megabytes(source):.1f} MB before, "
        f"{_megabytes(output):.1f} MB now"
    )


@map_app.command("prune")
def map_prune(
    source: Annotated[Path, typer.Argument(help="file of Gaussians in any supported format")],
    output: Annotated[Path, typer.Option("-o", "--output", help=".ply or .spz")],
    keep: Annotated[
        str | None, typer.Option(help="how many to keep: a count, or a share such as 50%")
    ] = None,
    max_ms: Annotated[
        float | None, typer.Option(help="keep as many as render in this time, here", min=0.1)
    ] = None,
    cameras: Annotated[
        Path | None, typer.Option(help="training cameras, as for map compile; default: found")
    ] = None,
    views: Annotated[int, typer.Option(help="most views to judge by", min=4, max=500)] = 48,
    size: Annotated[int, typer.Option(help="longer side of the judged renders", min=32)] = 640,
    threads: Annotated[int, typer.Option(help="threads of the renderer", min=1)] = 2,
) -> None:
    """Leave out the least important Gaussians; says what that costs in PSNR."""
    from igaussian_core.compile_map import training_images
    from igaussian_core.gaussian_map import load_map, save_map
    from igaussian_core.overview import kind_of
    from igaussian_core.pruning import prune
    from igaussian_core.view_planning import plan_views

    gmap = load_map(source)
    count = _count(keep, len(gmap))
    posed = training_images(source, cameras) if cameras is not None else []
    with progress_bars() as progress:
        plan = plan_views(
            gmap, posed, kind=None if posed else kind_of(gmap), radius=None, up=None, count=views,
            max_side=size, threads=threads, progress=Stages(progress),
        )  # fmt: skip
    chosen = plan.views[:views]
    result = prune(gmap, chosen, count, max_ms, threads)
    save_map(result.gmap, output)
    console.print(
        f"{output}: {len(result.gmap):,} of {len(gmap):,} Gaussians; against the whole map at "
        f"{len(result.psnr)} views: PSNR {result.psnr.mean():.1f} dB, worst "
        f"{result.psnr.min():.1f} dB; a render takes {result.milliseconds:.1f} ms, before "
        f"{result.milliseconds_before:.1f} ms ({threads} threads)"
    )


def _count(text: str | None, total: int) -> int | None:
    """A count, or a share of `total` with a per cent sign."""
    if text is None:
        return None
    try:
        value = float(text[:-1]) / 100 * total if text.endswith("%") else int(text)
    except ValueError as error:
        raise ConfigError(f"--keep {text}: expected a count, or a share such as 50%") from error
    return round(value)


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
        except (OSError, TypeError, ValueError) as error:
            raise ConfigError(f"{matrix}: {error}") from error
    else:
        if not (np.isfinite(scale) and scale > 0):
            raise ConfigError(f"--scale {scale}: must be positive")
        axis, point = direction(up, "--up"), numbers(origin, 3, "--origin")
        rotation = up_rotation(np.array(axis)).T if axis else np.eye(3)
        T_map_scene = Sim3(scale, rotation, -scale * rotation @ np.array(point or (0.0,) * 3))
    manifest = with_T_map_scene(path, T_map_scene)
    console.print(f"{path}: T_map_scene = {json.dumps(manifest.T_map_scene)}")


@map_app.command("calibrate")
def map_calibrate(
    path: Annotated[Path, typer.Argument(help="compiled map directory")],
    photos: Annotated[Path, typer.Option(help="photos with poses, as for map compile")],
    map_json: Annotated[
        Path | None, typer.Option(help="names the photos trained on; default: beside the photos")
    ] = None,
    config: ConfigOption = None,
    set_: SetOption = None,
) -> None:
    """Scale the covariance by what photos with poses show; held-out ones where map.json tells."""
    from igaussian_core.calibrate import calibrate_map

    with progress_bars() as progress:
        found = calibrate_map(
            path, photos, map_json, load_config(config, set_), Stages(progress)
        )
    kind = "held out" if found.held_out else "perhaps trained on: the covariance may be too small"
    console.print(
        f"{path}: covariance times {found.scale:.3g}, measured on {found.poses} of "
        f"{found.photos} photos ({kind}); before, the mean NEES was {found.mean_nees:.1f} and "
        f"{found.inside_95:.0%} of the errors were inside the 95 % ellipsoid"
    )


def _megabytes(path: Path) -> float:
    """Size of a file, or of all files in a folder."""
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(f.stat().st_size for f in files if f.is_file()) / 1e6


FxOption = Annotated[float | None, typer.Option(help="focal length in pixels")]


@app.command()
def render(
    source: Annotated[Path, typer.Argument(help="file of Gaussians or compiled map")],
    output: Annotated[
        Path, typer.Option("-o", "--output", help="picture; for --orbit a folder, .mp4 or .gif")
    ],
    camera: Annotated[
        Path | None,
        typer.Option(help="camera poses, as for map compile; default: a view that shows the map"),
    ] = None,
    index: Annotated[int, typer.Option(help="which of the cameras")] = 0,
    depth: Annotated[
        Path | None,
        typer.Option(help="write depth too: 16-bit .png, thousandths of a unit where they fit"),
    ] = None,
    depth_colour: Annotated[
        Path | None, typer.Option(help="write depth as colours too: near red, far blue")
    ] = None,
    orbit: Annotated[
        int | None, typer.Option(help="this many pictures around the view", min=2, max=10000)
    ] = None,
    size: Annotated[str, typer.Option(help="of the automatic view: WIDTHxHEIGHT")] = "960x720",
    background: Annotated[
        str | None, typer.Option(help="r,g,b in 0 to 1; default: white behind objects")
    ] = None,
    fps: Annotated[float, typer.Option(help="pictures a second of a video", min=0.1)] = 20.0,
) -> None:
    """Make a picture of a map, a depth picture, or an orbit."""
    from igaussian_core.geometry import inverse
    from igaussian_core.pictures import (
        colour_depth,
        depth_scale,
        depth_steps,
        to_uint8,
        write_picture,
        write_sequence,
    )  # fmt: skip

    look = _look(source, camera, index, numbers(size.replace("x", ","), 2, "--size"))
    colour = numbers(background, 3, "--background") or look.background
    if orbit is not None:
        frames = (
            to_uint8(look.gmap.render(look.camera, inverse(T), colour)[0])
            for T in look.orbit(orbit)
        )
        console.print(f"{output}: {write_sequence(output, frames, fps)} pictures")
        return
    rgb, z, alpha = look.gmap.render(look.camera, inverse(look.T_scene_cam), colour)
    write_picture(output, to_uint8(rgb))
    if depth is not None:
        scale = depth_scale(z)
        write_picture(depth, depth_steps(z, scale))
        console.print(f"{depth}: depth in steps of 1/{scale:g} scene unit, 0 where there is none")
    if depth_colour is not None:
        write_picture(depth_colour, colour_depth(z, alpha))


@dataclasses.dataclass(frozen=True)
class _Look:
    """A map and the view of it to render."""

    gmap: Any
    camera: Any
    T_scene_cam: Any
    background: tuple[float, ...]
    kind: str

    def orbit(self, count: int) -> Any:
        from igaussian_core.overview import likely_up, orbit, view_target

        up = likely_up(self.gmap, self.kind)
        target = view_target(self.gmap, self.camera, self.T_scene_cam)
        if self.kind == "object":
            low, high = self.gmap.bounds()
            target = 0.5 * (low + high)
        return orbit(self.kind, self.T_scene_cam, target, up.vector, count)


def _look(
    source: Path, camera: Path | None, index: int, size: tuple[float, ...] | None
) -> _Look:
    """The map with the view that was asked for, else with one that shows it."""
    from igaussian_core.errors import MapError
    from igaussian_core.gaussian_map import load_map
    from igaussian_core.map_package import is_package, open_package
    from igaussian_core.overview import kind_of, overview
    from igaussian_core.posed_images import read_posed_images

    package = open_package(source) if is_package(source) else None
    gmap = package.gaussians if package else load_map(source)
    if len(gmap) == 0:
        raise MapError(f"{source}: the map holds no Gaussian: nothing to render")
    kind = package.manifest.kind if package else kind_of(gmap)
    background = (1.0, 1.0, 1.0) if kind == "object" else (0.0, 0.0, 0.0)
    if package:
        background = tuple(package.manifest.background)  # type: ignore[assignment]
    if camera is None:
        width, height = size or (960, 720)
        view = overview(gmap, int(width), int(height), kind)
        return _Look(gmap, view.camera, view.T_scene_cam, background, kind)
    posed = read_posed_images(camera)
    if not 0 <= index < len(posed):
        raise ConfigError(f"--index {index}: {camera} holds {len(posed)} cameras")
    chosen = posed[index]
    return _Look(gmap, chosen.camera.undistorted(), chosen.T_scene_cam, background, kind)


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
    """Where was a photo taken? Exit code 3 where that cannot be said."""
    from igaussian_core.camera import Camera
    from igaussian_core.geometry import compose, rotation_from_quaternion
    from igaussian_core.localizer import Localizer
    from igaussian_core.posed_images import read_image

    image = read_image(photo)
    height, width = image.shape[:2]
    coefficients = numbers(dist, len(dist.replace(",", " ").split()), "--dist") if dist else None
    camera = Camera(
        width, height, fx, fy or fx,
        (width - 1) / 2 if cx is None else cx, (height - 1) / 2 if cy is None else cy,
        model, coefficients or (),
    )  # fmt: skip
    guess = numbers(prior, 7, "--prior")
    if guess and not any(guess[3:]):
        raise ConfigError(f"--prior '{prior}': the quaternion is all zero")
    T_prior = compose(rotation_from_quaternion(guess[3:]), guess[:3]) if guess else None
    result = Localizer.open(map_path, load_config(config, set_)).localize(image, camera, T_prior)
    if as_json:
        print(json.dumps(result_json(result)))
    else:
        _print_result(result)
    if not result.ok:
        raise typer.Exit(3)


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
        degrees = np.round(np.degrees(sigma[3:]), 3).tolist()
        console.print(f"rotation w x y z  {quaternion}  +- {degrees} deg")
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


if __name__ == "__main__":
    main()
