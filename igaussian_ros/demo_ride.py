"""The demo's drive over DDS: node and replay as processes of their own, a listener in this one."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from igaussian_core.bags import IMAGE, ODOMETRY, Bag
from igaussian_core.errors import IGaussianError
from igaussian_core.evaluate.drive import DriveFrame, MemorySample, Trajectory
from igaussian_core.evaluate.drive_run import resident_mb
from igaussian_core.replay import camera_mounting
from igaussian_core.resources import resource
from igaussian_core.result import Status
from igaussian_ros.demo import DemoOptions, Ride

if TYPE_CHECKING:  # the middleware reads its environment when it is imported
    from igaussian_ros.listener import HeardStatus, Listener

Array = NDArray[np.float64]

_START_S, _STOP_S = 90.0, 10.0
_SAMPLE_S = 0.5
_QUIET_S = 1.5  # after the replay: so long without news is the end
# a defect inside the pipeline counts against it; a refused message (stale, no camera_info) is
# counted by itself
_PROCESSED = {status.value for status in Status} | {"failed"}


@dataclass(frozen=True)
class Topics:
    """The recording's topics, and where its camera sits on its robot."""

    image: str
    camera_info: str
    truth: str
    compressed: bool
    odometry: str = ""
    odom_frame: str = "odom"
    base_frame: str = "base_link"
    T_base_cam: Array | None = None


def find_topics(bag: Bag, truth_topic: str | None) -> Topics:
    """What the node must be told of a recording.

    Raises:
        BagError: a needed topic is missing.
    """
    image = bag.image_topic()
    plain = Topics(
        image,
        bag.camera_info_topic(image),
        truth_topic or bag.pose_topic(),
        bag.topics[image].type != IMAGE,
    )
    if len(bag.topics_of(ODOMETRY)) != 1:
        return plain
    odometry = bag.odometry()
    T_base_cam = camera_mounting(bag, odometry[0].child, image) if odometry else None
    if T_base_cam is None:
        return plain
    return Topics(
        plain.image, plain.camera_info, plain.truth, plain.compressed,
        bag.topics_of(ODOMETRY)[0], odometry[0].frame, odometry[0].child, T_base_cam,
    )  # fmt: skip


def node_arguments(topics: Topics, map_path: Path, options: DemoOptions) -> list[str]:
    """ROS arguments of the localizer for a recording."""
    values: dict[str, Any] = {
        "map_path": map_path.resolve(),
        "image_topic": topics.image,
        "camera_info_topic": topics.camera_info,
        "image_transport": "compressed" if topics.compressed else "raw",
    }
    if topics.T_base_cam is not None:
        from igaussian_ros.convert import pose_to_ros

        pose = pose_to_ros(topics.T_base_cam)
        p, q = pose.position, pose.orientation
        numbers = ", ".join(repr(float(v)) for v in (p.x, p.y, p.z, q.x, q.y, q.z, q.w))
        values |= {
            "odom_topic": topics.odometry,
            "odom_frame": topics.odom_frame,
            "base_frame": topics.base_frame,
            "base_to_camera": f"[{numbers}]",
        }
    defaults = type(options.config)().to_flat()
    values |= {k: v for k, v in options.config.to_flat().items() if v != defaults[k]}
    return ["--ros-args", *(a for k, v in values.items() for a in ("-p", f"{k}:={_yaml(v)}"))]


def _yaml(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def ride_with_ros(
    options: DemoOptions,
    bag_path: Path,
    map_path: Path,
    truth: Trajectory,
    on_frame: Callable[[DriveFrame], None],
    tick: Callable[[str], None],
    console: Console,
) -> Ride:
    """Replay the recording to the real node over DDS.

    Raises:
        IGaussianError: a process that does not start, or ends with an error.
    """
    domain = _isolate()
    with Bag(bag_path) as bag:
        topics = find_topics(bag, options.truth_topic)
        image_stamps = header_stamps(bag, topics.image)
    logs = options.work_dir / "demo"
    logs.mkdir(parents=True, exist_ok=True)
    console.print(f"ROS_DOMAIN_ID={domain}, logs in {logs}")
    replay = [str(bag_path), "--stamp", "now", "--rate", str(options.rate)]
    replay += ["--wait-for-subscribers", "20"]
    if options.duration_s is not None:
        replay += ["--duration", str(options.duration_s)]
    arguments = node_arguments(topics, map_path, options)
    with (
        _ending_on_sigterm(),
        _listening(topics.truth) as listener,
        Child("igaussian_ros.localizer_node", arguments, logs / "localizer.log") as node,
    ):
        tick("the node loads the map")
        _wait_until_ready(listener, node)
        watch = _Watch(listener, topics, truth, image_stamps, options.rate, on_frame)
        with Child("igaussian_ros.replay", replay, logs / "replay.log") as player:
            tick("replaying over DDS")
            memory = _follow(watch, node, player)
            if player.wait(_STOP_S) != 0:
                raise IGaussianError(f"the replay failed: {player.last_line()}")
        status = node.stop()
    if status != 0:
        console.print(f"[red]the node ended with status {status}, see {node.log}[/]")
    begin_s = watch.frames[0].arrived_s if watch.frames else 0.0
    memory = [MemorySample(m.time_s - begin_s, m.rss_mb) for m in memory if m.time_s >= begin_s]
    how = "over DDS: node and replay as processes of their own"
    return Ride(watch.frames, memory, how, watch.refused)


@contextmanager
def _ending_on_sigterm() -> Iterator[None]:
    """Leave by way of the blocks that end the child processes."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def header_stamps(bag: Bag, topic: str) -> list[int]:
    """Header stamps of a topic's messages, nanoseconds."""
    stamps = []
    for _, message in bag.read((topic,)):
        stamps.append(message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec)
    return stamps


def _isolate() -> int:
    """Environment of this process and its children: this machine only, a domain of its own."""
    domain = 1 + os.getpid() % 100
    os.environ["ROS_DOMAIN_ID"] = str(domain)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ.pop("ROS_LOCALHOST_ONLY", None)
    # a shell's choice of middleware may not be among those of this environment
    os.environ.pop("RMW_IMPLEMENTATION", None)
    if "FASTRTPS_DEFAULT_PROFILES_FILE" not in os.environ:
        profile = resource("msg_configs/fastdds_large_images.xml")
        os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(profile)
    return domain


class Child:
    """A Python module as a process in a session of its own, ended at the latest with its block."""

    def __init__(self, module: str, arguments: list[str], log: Path) -> None:
        self.module, self.log = module, log
        self._file: IO[bytes] = log.open("wb")
        self._process = subprocess.Popen(
            [sys.executable, "-m", module, *arguments],
            stdin=subprocess.DEVNULL, stdout=self._file, stderr=subprocess.STDOUT,
            start_new_session=True,
        )  # fmt: skip

    def __enter__(self) -> Child:
        return self

    def __exit__(self, *error: object) -> None:
        if self.running:
            self._signal(signal.SIGKILL)
            self._process.wait()
        self._file.close()

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def running(self) -> bool:
        return self._process.poll() is None

    def wait(self, timeout_s: float) -> int | None:
        try:
            return self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return None

    def stop(self) -> int | None:
        """SIGINT to the group; the status, None where it does not end."""
        self._signal(signal.SIGINT)
        return self.wait(_STOP_S)

    def last_line(self) -> str:
        """What it said last."""
        lines = self.log.read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else f"{self.module} said nothing"

    def _signal(self, number: int) -> None:
        try:
            os.killpg(self.pid, number)
        except ProcessLookupError:
            return


@contextmanager
def _listening(truth_topic: str) -> Iterator[Listener]:
    """A Listener that spins on a thread of its own."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.signals import SignalHandlerOptions

    from igaussian_ros.listener import Listener

    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    listener = Listener(truth_topic=truth_topic)
    executor = SingleThreadedExecutor()
    executor.add_node(listener)
    over = threading.Event()

    def spin() -> None:
        while not over.is_set():
            executor.spin_once(timeout_sec=0.1)

    spinner = threading.Thread(target=spin, name="listener", daemon=True)
    spinner.start()
    try:
        yield listener
    finally:
        over.set()
        spinner.join()
        executor.shutdown()
        listener.destroy_node()
        rclpy.try_shutdown()


def _wait_until_ready(listener: Listener, node: Child) -> None:
    deadline = time.monotonic() + _START_S
    while listener.diagnostics.get("state") not in ("waiting for images", "no images"):
        if not node.running:
            raise IGaussianError(f"the node did not start: {node.last_line()} (see {node.log})")
        if time.monotonic() > deadline:
            raise IGaussianError(f"the node was not ready within {_START_S:g} s, see {node.log}")
        if listener.diagnostics.get("map"):
            return
        time.sleep(0.05)


def _follow(watch: _Watch, node: Child, player: Child) -> list[MemorySample]:
    """Until the replay is over and the node quiet; the node's memory by wall time."""
    last_news = next_sample = time.monotonic()
    memory = []
    while True:
        now = time.monotonic()
        if now >= next_sample:
            memory.append(MemorySample(time.time(), resident_mb(node.pid)))
            next_sample += _SAMPLE_S
        if watch.take() > 0 or player.running:
            last_news = now
        if now - last_news > _QUIET_S:
            watch.take(final=True)
            return memory
        if not node.running:
            raise IGaussianError(f"the node ended early: {node.last_line()} (see {node.log})")
        time.sleep(0.03)


class _Watch:
    """Makes DriveFrames of what the listener hears, with the recording's own stamps."""

    def __init__(
        self,
        listener: Listener,
        topics: Topics,
        truth: Trajectory,
        image_stamps_ns: list[int],
        rate: float,
        on_frame: Callable[[DriveFrame], None],
    ) -> None:
        self._listener, self._topics, self._truth = listener, topics, truth
        self._image_stamps = np.array(sorted(image_stamps_ns), np.int64)
        self._rate, self._on_frame = rate, on_frame
        self._taken = 0
        self._offset_ns: float | None = None
        self.frames: list[DriveFrame] = []
        self.refused = 0

    def take(self, final: bool = False) -> int:
        """Turn new statuses into frames; how many there were.

        A pose and its status come on two topics: a status waits for its pose a little.
        """
        count = 0
        if not self._listener.truth and not final:
            return 0  # recorded stamps are found by the true poses
        while self._taken < len(self._listener.statuses):
            status = self._listener.statuses[self._taken]
            pose = self._pose_at(status.stamp_ns)
            ok = status.values.get("status") in (Status.OK.value, Status.OK_DEGRADED.value)
            if ok and pose is None and not final and time.time_ns() - status.received_ns < 3e8:
                break
            self._taken += 1
            count += 1
            if status.values.get("status") in _PROCESSED:
                self._add(status, pose)
            else:
                self.refused += 1
        return count

    def _pose_at(self, stamp_ns: int) -> tuple[Array, int] | None:
        for pose in reversed(self._listener.poses):
            if pose.stamp_ns == stamp_ns:
                return pose.T, pose.received_ns
        return None

    def _add(self, status: HeardStatus, pose: tuple[Array, int] | None) -> None:
        stamp_ns = self._recorded_stamp(status.stamp_ns)
        first_ns = self.frames[0].stamp_ns if self.frames else stamp_ns
        from igaussian_ros.convert import moved_covariance

        T_map_cam, covariance, latency_ms = None, None, math.nan
        received_ns = status.received_ns
        if pose is not None:
            T_map_x, received_ns = pose
            T_base_cam = self._topics.T_base_cam
            T_map_cam = T_map_x if T_base_cam is None else T_map_x @ T_base_cam
            covariance = self._listener.covariances.get(status.stamp_ns)
            if covariance is not None:
                covariance = moved_covariance(covariance, T_map_x, T_map_cam)
            latency_ms = (received_ns - status.stamp_ns) * 1e-6
        values = status.values
        frame = DriveFrame(
            stamp_ns, (stamp_ns - first_ns) * 1e-9, values["status"], values.get("reason", ""),
            T_map_cam, self._truth.at(stamp_ns), int(values.get("inliers", 0)), latency_ms,
            received_ns * 1e-9, _timings(values), covariance,
        )  # fmt: skip
        self.frames.append(frame)
        self._on_frame(frame)

    def _recorded_stamp(self, stamp_ns: int) -> int:
        """The recording's stamp of an image whose stamp was moved to the present."""
        if self._offset_ns is None:
            self._offset_ns = self._find_offset()
        guess = stamp_ns * self._rate - self._offset_ns
        nearest = self._image_stamps[np.argmin(np.abs(self._image_stamps - guess))]
        return int(nearest)

    def _find_offset(self) -> float:
        """moved * rate - recorded, by the true poses, which were moved likewise.

        A robot that stands still repeats its pose: of all offsets that explain the first pose
        heard, the one that explains most others is right.
        """
        heard = [(pose.stamp_ns, pose.T) for pose in self._listener.truth]
        if not heard:
            raise IGaussianError(f"nothing was heard on {self._topics.truth}")
        first_ns, first = heard[0]
        recorded = zip(self._truth.stamps_ns, self._truth.poses, strict=True)
        candidates = [first_ns * self._rate - ns for ns, T in recorded if np.allclose(T, first)]
        if not candidates:
            raise IGaussianError(f"{self._topics.truth}: poses that are not the recording's")

        def agreeing(offset: float) -> int:
            count = 0
            for moved_ns, T in heard[:: max(1, len(heard) // 50)]:
                true = self._truth.at(round(moved_ns * self._rate - offset))
                count += true is not None and bool(np.allclose(true, T, atol=1e-3))
            return count

        return max(candidates, key=agreeing)


def _timings(values: dict[str, str]) -> dict[str, float]:
    prefix, suffix = "timing.", "_ms"
    return {
        key[len(prefix) : -len(suffix)]: float(value)
        for key, value in values.items()
        if key.startswith(prefix)
    }
