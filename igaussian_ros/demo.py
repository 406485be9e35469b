"""`igaussian demo`: a recorded drive through the real node, watched live, judged at the end.

Nothing here needs ROS to be imported; without rclpy the same recording goes through the same
worker and tracker inside this process.
"""

from __future__ import annotations

import importlib.util
import json
import os
import platform
import shutil
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from igaussian_core.bags import Bag
from igaussian_core.compile_map import compile_map
from igaussian_core.config import Config
from igaussian_core.errors import IGaussianError, MapError
from igaussian_core.evaluate.drive import DriveFrame, MemorySample, Trajectory, summarize_drive
from igaussian_core.evaluate.drive_overlays import make_overlays
from igaussian_core.evaluate.drive_recording import write_recording
from igaussian_core.evaluate.drive_report import Drive, missed, write_report
from igaussian_core.evaluate.drive_run import run_drive
from igaussian_core.evaluate.metrics import plain
from igaussian_core.features import make_matcher
from igaussian_core.gaussian_map import file_sha256
from igaussian_core.localizer import Localizer
from igaussian_core.map_package import open_package
from igaussian_core.resources import resource
from igaussian_core.training.map_network import add_untrained_network

# what the bundled drive has to reach; a drive of one's own is only reported
BUNDLED_LIMITS: Mapping[str, float] = {
    "accepted_ratio": 0.95,
    "median_error_m": 0.02,
    "median_error_deg": 0.3,
    "max_error_m": 0.10,
    "max_error_deg": 2.0,
    "rate_hz": 2.9,
    "latency_ms_p95": 500.0,
    "rss_mb": 1500.0,
}
_ROWS = 12  # lines of the live table
_COLUMNS = ("t [s]", "x [m]", "y [m]", "z [m]", "error", "", "inliers", "latency", "rate")


@dataclass(frozen=True)
class DemoOptions:
    """What to show.

    Attributes:
        bag: recording with images, camera_info and true poses; None: the bundled drive.
        map: compiled map or .ply; None: the bundled room.
        cameras: the .ply's training cameras; None: those beside the bundled room, else none.
        work_dir: holds compiled maps, report and recording.
        rate: of the replay; latencies mean what they say at 1 only.
        duration_s: so much of the recording only.
        without_ros: replay inside this process even where ROS is there.
        truth_topic: None: found in the bag.
        overlays: pictures in the report.
        config: of the compilation and of the localizer.
    """

    bag: Path | None = None
    map: Path | None = None
    cameras: Path | None = None
    work_dir: Path = Path("out")
    rate: float = 1.0
    duration_s: float | None = None
    without_ros: bool = False
    truth_topic: str | None = None
    overlays: int = 6
    config: Config = Config()

    @property
    def bundled(self) -> bool:
        return self.bag is None and self.map is None


@dataclass(frozen=True)
class Ride:
    """What a way of running the drive brings back; `refused` messages were not processed."""

    frames: list[DriveFrame]
    memory: list[MemorySample]
    how: str
    refused: int = 0


@dataclass(frozen=True)
class DemoOutcome:
    """Figures by name, and where the report and the recording lie."""

    figures: dict[str, float]
    report: Path
    recording: Path
    failures: list[str]


def run_demo(
    options: DemoOptions, json_path: Path | None = None, console: Console | None = None
) -> DemoOutcome:
    """Localize a recorded drive, show it live, write report, recording and figures.

    Raises:
        IGaussianError: bag or map cannot be used; the node did not start.
    """
    console = console or Console()
    bag_path = options.bag or _bundled("bags/demo/drive")
    with Bag(bag_path) as bag:
        truth = Trajectory(bag.poses(options.truth_topic))
        sent = _images_in(bag, options.duration_s)
    map_path = prepare_map(options, console)
    table = DriveTable(console)
    console.print(f"recording {bag_path}: {sent} images, {len(truth)} true poses")
    with table:
        ride = _ride(options, bag_path, map_path, truth, table.add, table.tick, console)
    if not ride.frames:
        raise IGaussianError(f"{bag_path}: no frame was processed ({ride.how})")
    figures = summarize_drive(ride.frames, sent, ride.memory) | {"refused": float(ride.refused)}
    outcome = _write(options, bag_path, map_path, truth, ride, figures)
    if json_path is not None:
        json_path.parent.mkdir(parents=True, exist_ok=True)
        json_path.write_text(json.dumps(plain(figures), indent=1) + "\n")
    _print_outcome(console, outcome, ride)
    return outcome


def _images_in(bag: Bag, duration_s: float | None) -> int:
    """Images in the part of the recording that is played, which begins with its first message."""
    topic, begin_ns, count = bag.image_topic(), None, 0
    for message in bag.messages():
        begin_ns = message.log_time_ns if begin_ns is None else begin_ns
        if duration_s is not None and (message.log_time_ns - begin_ns) * 1e-9 > duration_s:
            break
        count += message.topic == topic
    return count


# --- the map ---


def prepare_map(options: DemoOptions, console: Console) -> Path:
    """The compiled map, compiled first where that was not done or the .ply has changed."""
    source = options.map or _bundled("bags/demo/room.ply")
    if source.is_dir():
        open_package(source)  # a bad map is told of now
        return source
    if not source.exists():
        raise IGaussianError(f"{source}: no such file")
    target = options.work_dir / f"{source.stem}.igmap"
    if _is_current(target, source, options.config):
        console.print(f"map {target}: compiled already")
        return target
    cameras = options.cameras
    if cameras is None and options.map is None:
        cameras = _bundled("bags/demo/mapping_cameras.json")
    options.work_dir.mkdir(parents=True, exist_ok=True)
    begin = time.monotonic()
    with Progress(
        TextColumn("compiling the map: {task.description}"), BarColumn(), MofNCompleteColumn(),
        TimeElapsedColumn(), console=console,
    ) as progress:  # fmt: skip
        tasks: dict[str, Any] = {}

        def show(stage: str, done: int, of: int) -> None:
            if stage not in tasks:
                tasks[stage] = progress.add_task(stage, total=of)
            progress.update(tasks[stage], completed=done, total=of)

        compile_map(source, target, cameras, None, options.config, show)
        try:
            add_untrained_network(target, options.config.runtime.threads, show)
        except MapError as error:
            console.print(f"no pose network, landmarks alone: {error}")
    console.print(f"map {target}: compiled in {time.monotonic() - begin:.0f} s")
    return target


def _is_current(target: Path, source: Path, config: Config) -> bool:
    if not target.is_dir():
        return False
    try:
        manifest = open_package(target).manifest
    except IGaussianError:
        return False
    same_features = manifest.matcher == make_matcher(config.features).name
    return same_features and manifest.source_sha256 == file_sha256(source)


def _bundled(name: str) -> Path:
    return resource(name)


# --- the drive ---


def has_ros() -> bool:
    """True where rclpy and the messages can be imported."""
    return all(importlib.util.find_spec(name) for name in ("rclpy", "sensor_msgs", "nav_msgs"))


def _ride(
    options: DemoOptions,
    bag_path: Path,
    map_path: Path,
    truth: Trajectory,
    on_frame: Callable[[DriveFrame], None],
    tick: Callable[[str], None],
    console: Console,
) -> Ride:
    if options.without_ros or not has_ros():
        why = "asked for" if options.without_ros else "rclpy is not installed"
        console.print(f"[yellow]without ROS ({why}): worker and tracker run in this process[/]")
        return ride_without_ros(options, bag_path, map_path, truth, on_frame)
    from igaussian_ros.demo_ride import ride_with_ros

    return ride_with_ros(options, bag_path, map_path, truth, on_frame, tick, console)


def ride_without_ros(
    options: DemoOptions,
    bag_path: Path,
    map_path: Path,
    truth: Trajectory,
    on_frame: Callable[[DriveFrame], None],
) -> Ride:
    """The recording through NewestFrameWorker and Tracker in this process."""
    localizer = Localizer.open(map_path, options.config)
    with Bag(bag_path) as bag:
        run = run_drive(
            bag, localizer, options.config, truth, options.rate, options.duration_s,
            on_frame=on_frame,
        )  # fmt: skip
    return Ride(run.frames, run.memory, "without ROS, in one process")


# --- what is shown ---


class DriveTable:
    """A live table of the last frames; plain lines where the output is no terminal."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._frames: deque[DriveFrame] = deque(maxlen=_ROWS)
        self._arrivals: deque[float] = deque(maxlen=12)
        self._counts = [0, 0]  # processed, accepted
        self._state = ""
        self._last_line = -1e9
        self._live: Live | None = None

    def __enter__(self) -> DriveTable:
        if self._console.is_terminal:
            self._live = Live(self._view(), console=self._console, refresh_per_second=5)
            self._live.start()
        return self

    def __exit__(self, *error: object) -> None:
        if self._live is not None:
            self._live.update(self._view())
            self._live.stop()

    def add(self, frame: DriveFrame) -> None:
        """Show a frame."""
        self._frames.append(frame)
        self._counts[0] += 1
        if frame.T_map_cam is not None:
            self._counts[1] += 1
            self._arrivals.append(frame.arrived_s)
        if self._live is not None:
            self._live.update(self._view())
        elif frame.time_s - self._last_line >= 1.0 or frame.T_map_cam is None:
            if self._last_line < 0:
                self._line(_COLUMNS)
            self._last_line = frame.time_s
            self._line(self._cells(frame))

    def tick(self, state: str) -> None:
        """Say what is being waited for."""
        if state == self._state:
            return
        self._state = state
        if self._live is not None:
            self._live.update(self._view())
        else:
            self._console.print(state, highlight=False, soft_wrap=True)

    def _line(self, cells: Sequence[str]) -> None:
        text = " ".join(f"{cell:>9}" for cell in cells)
        self._console.print(Text(text), soft_wrap=True)

    def _hz(self) -> float:
        if len(self._arrivals) < 2:
            return float("nan")
        return (len(self._arrivals) - 1) / max(self._arrivals[-1] - self._arrivals[0], 1e-9)

    def _cells(self, frame: DriveFrame) -> list[str]:
        head = f"{frame.time_s:.1f}"
        if frame.T_map_cam is None:
            return [head, "lost:", frame.status, "", "", "", str(frame.inliers), "", ""]
        x, y, z = frame.T_map_cam[:3, 3]
        angle_deg, distance_m = frame.error
        return [
            head, f"{x:.2f}", f"{y:.2f}", f"{z:.2f}", f"{distance_m * 100:.2f}cm",
            f"{angle_deg:.3f}°", str(frame.inliers), f"{frame.latency_ms:.0f}ms",
            f"{self._hz():.1f}Hz",
        ]  # fmt: skip

    def _view(self) -> Group:
        table = Table(box=None, pad_edge=False)
        for name in _COLUMNS:
            table.add_column(Text(name), justify="right", min_width=7)
        for frame in self._frames:
            table.add_row(*self._cells(frame), style="red" if frame.T_map_cam is None else "")
        processed, accepted = self._counts
        return Group(table, Text(f"{self._state}  {accepted} of {processed} frames localized"))


def _print_outcome(console: Console, outcome: DemoOutcome, ride: Ride) -> None:
    figures = outcome.figures
    table = Table(title=f"The drive, {ride.how}", show_header=False)
    rows = (
        ("frames", "{accepted:.0f} accepted of {processed:.0f} processed; {sent:.0f} sent, "
         "{refused:.0f} refused"),
        ("position error", "median {median_error_m:.4f} m, largest {max_error_m:.4f} m"),
        ("rotation error", "median {median_error_deg:.3f} deg, largest {max_error_deg:.3f} deg"),
        ("poses a second", "{rate_hz:.2f}"),
        (
            "latency",
            "median {latency_ms_p50:.0f} ms, 95 % {latency_ms_p95:.0f} ms, "
            "last quarter against second {latency_growth_ms:+.0f} ms",
        ),
        (
            "memory",
            "at most {rss_mb:.0f} MB, last quarter against second {rss_growth_mb:+.1f} MB",
        ),
    )
    for name, text in rows:
        table.add_row(name, text.format(**figures))
    console.print(table)
    for line in outcome.failures:
        console.print(f"[red]not reached: {line}[/]")
    console.print(f"report     {outcome.report}")
    console.print(f"recording  {outcome.recording}")


# --- what is kept ---


def _write(
    options: DemoOptions,
    bag_path: Path,
    map_path: Path,
    truth: Trajectory,
    ride: Ride,
    figures: dict[str, float],
) -> DemoOutcome:
    folder = options.work_dir / "demo"
    localizer = Localizer.open(map_path, options.config)
    with Bag(bag_path) as bag:
        overlays = make_overlays(bag, localizer, ride.frames, options.overlays)
        small = make_overlays(bag, localizer, ride.frames, 40, max_side=320)
    recording = folder / "recording"
    if recording.exists():
        shutil.rmtree(recording)
    folder.mkdir(parents=True, exist_ok=True)
    write_recording(recording, ride.frames, truth, small)
    package = open_package(map_path)
    points = package.T_map_scene.points(package.gaussians.means).astype(np.float32)
    limits = BUNDLED_LIMITS if options.bundled and options.rate == 1.0 else {}
    title = "iGaussian: the bundled drive" if options.bundled else f"iGaussian: {bag_path.name}"
    drive = Drive(
        title, figures, ride.frames, truth, ride.memory, points, overlays, limits,
        _facts(options, bag_path, map_path, ride, len(package.gaussians)),
    )  # fmt: skip
    report = write_report(drive, folder)
    return DemoOutcome(figures, report, recording, missed(figures, limits))


def _facts(
    options: DemoOptions, bag_path: Path, map_path: Path, ride: Ride, gaussians: int
) -> dict[str, str]:
    return {
        "recording": str(bag_path),
        "map": f"{map_path} ({gaussians:,} Gaussians)",
        "how": ride.how,
        "replay rate": f"{options.rate:g}",
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
        "Python": platform.python_version(),
        **{name: str(value) for name, value in options.config.to_flat().items()},
    }
