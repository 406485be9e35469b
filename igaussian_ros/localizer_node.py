"""The ROS 2 node `localizer`: images in, poses in a Gaussian map out.

Callbacks only convert and hand over; a worker thread localizes the newest image and publishes.
"""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable
from concurrent.futures import Future as ThreadFuture
from pathlib import Path
from typing import Any

import cv2
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.executors import SingleThreadedExecutor, TimeoutException
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Header
from std_srvs.srv import SetBool, Trigger

from igaussian_core.camera import Camera
from igaussian_core.errors import CameraError, IGaussianError, MapError
from igaussian_core.localizer import Localizer
from igaussian_core.tracker import Tracker
from igaussian_core.worker import NewestFrameWorker
from igaussian_ros import convert, diagnostics, overlay, parameters
from igaussian_ros.camera_cache import CameraCache
from igaussian_ros.pipeline import FramePipeline, ImageMessage, Outcome
from igaussian_ros.tf import Frames, OdometryBuffer, create_tf_publisher, map_transform
from igaussian_ros.throttle import Throttle, key_of

_SHUTDOWN_S = 4.0  # ros2 launch kills 5 s after SIGINT


class LocalizerNode(Node):
    """Localizes a camera's images in a compiled Gaussian map.

    The constructor waits for nothing; `start` loads the map on a thread of its own.

    Raises:
        ConfigError: a parameter that cannot be used.
    """

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("localizer", **node_arguments)
        self._settings = parameters.declare(self)
        # rclpy ties a severity to the calling line: one lambda, one line, one severity
        self._warn = Throttle(lambda text: self.get_logger().warning(text))
        self._error = Throttle(lambda text: self.get_logger().error(text))
        for line in parameters.unknown_parameters(self):
            self.get_logger().warning(line)
        cv2.setNumThreads(self._settings.config.runtime.threads)

        self._cameras = CameraCache(self._settings["rectified"])
        self._pipeline = FramePipeline(self._settings, self._cameras)
        self._odometry = OdometryBuffer()  # T_odom_cam
        self._counters = diagnostics.Counters()
        self._rate_in, self._rate_out = diagnostics.RateMeter(), diagnostics.RateMeter()
        self._latency_ms, self._work_ms = diagnostics.Window(), diagnostics.Window()
        self._dropped_before = 0
        self._last: Outcome | None = None
        self._state = "no map"
        self._map_name = ""
        self._camera_frame = str(self._settings["camera_optical_frame"])
        self._paused = self._stopping = False
        self._loader: threading.Thread | None = None
        self._loading = threading.Lock()
        self._begin = self._last_image = time.monotonic()
        self._last_submitted = -1e9
        self._log_bridge = _bridge_logging(self)

        self._create_publishers()
        self._worker: NewestFrameWorker[ImageMessage] = NewestFrameWorker(self._handle)
        self._create_subscriptions()
        self._create_services()
        # wall time: it must tick while /clock stands still
        self.create_timer(1.0, self._on_tick, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._say_what_is_published()

    # --- set-up ---

    def _wanted_image_topic(self) -> str:
        topic = str(self._settings["image_topic"])
        if self._settings["image_transport"] == "compressed" and not topic.endswith("/compressed"):
            topic += "/compressed"
        return topic

    def _create_publishers(self) -> None:
        self._pose_publisher = self.create_publisher(PoseStamped, "~/pose", 10)
        self._covariance_publisher = self.create_publisher(
            PoseWithCovarianceStamped, "~/pose_with_covariance", 10
        )
        self._status_publisher = self.create_publisher(DiagnosticArray, "~/status", 10)
        self._diagnostics_publisher = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._overlay_publisher = self.create_publisher(Image, "~/debug/overlay", 1)
        self._tf_publisher = None
        if self._settings["publish_tf"]:
            self._tf_publisher = create_tf_publisher(self)
            if self._tf_publisher is None:
                self.get_logger().warning(
                    "publish_tf is set, but tf2_msgs is not installed (ROS 2 from PyPI has it "
                    "not): nothing is published on /tf"
                )

    def _create_subscriptions(self) -> None:
        settings, qos = self._settings, self._input_qos(1)
        image_type = CompressedImage if settings["image_transport"] == "compressed" else Image
        self._image_subscription = self.create_subscription(
            image_type, self._wanted_image_topic(), self._on_image, qos
        )
        self._info_subscription = self.create_subscription(
            CameraInfo, settings["camera_info_topic"], self._on_camera_info, qos
        )
        self.create_subscription(
            PoseWithCovarianceStamped, "initialpose", self._on_initial_pose, 10
        )
        if settings["odom_topic"]:
            self.create_subscription(
                Odometry, settings["odom_topic"], self._on_odometry, self._input_qos(50)
            )

    def _input_qos(self, depth: int) -> QoSProfile:
        reliable = self._settings["image_qos"] == "reliable"
        policy = ReliabilityPolicy.RELIABLE if reliable else qos_profile_sensor_data.reliability
        return QoSProfile(depth=depth, reliability=policy)

    def _create_services(self) -> None:
        # an awaiting service must not keep the others waiting
        group = ReentrantCallbackGroup()
        for name, kind, callback in (
            ("~/relocalize", Trigger, self._on_relocalize),
            ("~/reset", Trigger, self._on_reset),
            ("~/load_map", Trigger, self._on_load_map),
            ("~/pause", SetBool, self._on_pause),
        ):
            self.create_service(kind, name, callback, callback_group=group)

    def _say_what_is_published(self) -> None:
        settings = self._settings
        if settings["base_to_camera"]:
            what = f"the pose of '{settings['base_frame']}' (base_to_camera is given)"
        else:
            what = "the pose of the camera's optical frame (no base_to_camera is given)"
        self.get_logger().info(
            f"publishing {what} in '{settings['map_frame']}' on "
            f"{self._pose_publisher.topic_name}; images from "
            f"{self._image_subscription.topic_name}, calibration from "
            f"{self._info_subscription.topic_name}"
        )

    # --- loading a map ---

    def map_path(self) -> str:
        """The parameter, which may have changed since the start, with ~ expanded."""
        return os.path.expanduser(str(self.get_parameter("map_path").value))

    def start(self, on_failure: Callable[[str], None]) -> None:
        """Load the map of `map_path` on a thread of its own; images wait for it."""

        def report(loaded: bool, text: str) -> None:
            if not loaded:
                on_failure(text)

        self._begin_loading(self.map_path(), report)

    def _begin_loading(self, path: str, report: Callable[[bool, str], None]) -> bool:
        """False where another map is being loaded already."""
        if not self._loading.acquire(blocking=False):
            return False
        if self._pipeline.tracker is None:
            self._state = "loading the map"

        def run() -> None:
            try:
                loaded, text = self._load(path)
            finally:
                self._loading.release()
            report(loaded, text)

        self._loader = threading.Thread(target=run, name="map-loader", daemon=True)
        self._loader.start()
        return True

    def _load(self, path: str) -> tuple[bool, str]:
        """Open a map and hand it to the worker; the old one stays where that fails."""
        begin = time.monotonic()
        try:
            if not path:
                raise MapError("parameter map_path is empty: set it to a compiled map (.igmap)")
            localizer = Localizer.open(path, self._settings.config)
            localizer.warm_up()
            tracker = Tracker(localizer, self._settings.config)
            self._worker.call(lambda: self._use(tracker, path)).result()
        except IGaussianError as error:
            return False, str(error)
        except Exception as error:  # a defect, yet the old map still serves
            if self._stopping:
                return False, "the node is stopping"
            self.get_logger().error(traceback.format_exc())
            return False, f"{path}: {type(error).__name__}: {error}"
        text = f"map {path} loaded in {time.monotonic() - begin:.1f} s"
        self.get_logger().info(text)
        return True, text

    def _use(self, tracker: Tracker, path: str) -> None:
        self._pipeline.use(tracker)
        self._map_name = path
        self._state = "waiting for images"

    # --- callbacks: convert, hand over ---

    def _on_image(self, message: ImageMessage) -> None:
        now = time.monotonic()
        self._last_image = now
        self._camera_frame = self._pipeline.camera_frame(message)
        self._counters.add("received")
        self._rate_in.tick()
        if self._paused:
            self._counters.add("paused")
            return
        limit_hz = float(self.get_parameter("max_rate_hz").value or 0.0)
        if limit_hz > 0 and now - self._last_submitted < 1 / limit_hz:
            self._counters.add("throttled")
            return
        self._last_submitted = now
        self._worker.submit(message)

    def _on_camera_info(self, message: CameraInfo) -> None:
        frame = self._settings["camera_optical_frame"] or message.header.frame_id
        try:
            camera = self._cameras.update(message, frame)
        except CameraError as error:
            topic = self._info_subscription.topic_name
            self._warn(f"camera_info:{key_of(str(error))}", f"{topic} is not used: {error}")
            return
        if not message.d and not self._settings["rectified"]:
            self._say_once_undistorted(camera)

    def _say_once_undistorted(self, camera: Camera) -> None:
        self.get_logger().warning(
            f"{self._info_subscription.topic_name}: D is empty, images of {camera.width}x"
            f"{camera.height} are taken as free of distortion",
            once=True,
        )

    def _on_initial_pose(self, message: PoseWithCovarianceStamped) -> None:
        frame, map_frame = message.header.frame_id.lstrip("/"), self._settings["map_frame"]
        if frame and frame != map_frame:
            self._warn(
                "initialpose:frame",
                f"initial pose in frame '{frame}' ignored: it must be in '{map_frame}'",
            )
            return
        if not frame:
            self._warn(
                "initialpose:empty", f"initial pose without frame_id, taken as in '{map_frame}'"
            )
        try:
            T_map_x = convert.pose_from_ros(message.pose.pose)
        except convert.MessageError as error:
            self._warn("initialpose:values", f"initial pose ignored: {error}")
            return
        T_base_cam = self._settings.T_base_cam
        T_map_cam = T_map_x if T_base_cam is None else T_map_x @ T_base_cam
        self._pipeline.set_initial_pose(T_map_cam, convert.stamp_to_ns(message.header.stamp))
        x, y, z = T_map_cam[:3, 3]
        self.get_logger().info(
            f"initial pose: camera at {x:.2f} {y:.2f} {z:.2f}, tried first on the next image"
        )

    def _on_odometry(self, message: Odometry) -> None:
        settings, child = self._settings, message.child_frame_id
        T_x_cam = self._camera_in(child)
        if T_x_cam is None or message.header.frame_id != settings["odom_frame"]:
            no_extrinsic = child == settings["base_frame"] and settings.T_base_cam is None
            wanted = (
                "base_to_camera is not given"
                if no_extrinsic
                else f"wanted is base_frame '{settings['base_frame']}' or the camera's optical "
                f"frame, in odom_frame '{settings['odom_frame']}'"
            )
            self._warn(
                "odometry:frames",
                f"odometry of '{child}' in '{message.header.frame_id}' is not used: {wanted}",
            )
            return
        try:
            T_odom_cam = convert.pose_from_ros(message.pose.pose) @ T_x_cam
        except convert.MessageError as error:
            self._warn("odometry:values", f"odometry is not used: {error}")
            return
        stamp_ns = convert.stamp_to_ns(message.header.stamp)
        self._odometry.add(stamp_ns, T_odom_cam)
        self._pipeline.add_odometry(stamp_ns, T_odom_cam)

    def _camera_in(self, frame: str) -> Any | None:
        """T_frame_cam for the odometry's child frame; None where it is not known."""
        if frame == self._settings["base_frame"]:
            return self._settings.T_base_cam
        if frame and frame == self._camera_frame:
            return convert.identity()
        return None

    # --- services: hand over to loader or worker, answer when done ---

    async def _on_load_map(
        self, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        answer = self._new_future()
        path = self.map_path()
        if self._begin_loading(path, lambda *outcome: self._resolve(answer, outcome)):
            response.success, response.message = await answer
        else:
            response.message = "another map is being loaded"
        if not response.success:
            kept = f"; the map {self._map_name} stays" if self._map_name else ""
            self.get_logger().error(f"load_map: {response.message}{kept}")
        return response

    async def _on_relocalize(
        self, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        response.success, response.message = await self._on_worker(
            self._pipeline.reset, "the next image is localized without a prior"
        )
        return response

    async def _on_reset(
        self, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        response.success, response.message = await self._on_worker(
            self._reset, "track, odometry, camera_info and counts are forgotten"
        )
        return response

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._paused = bool(request.data)
        response.success = True
        response.message = "paused: images are ignored" if self._paused else "running"
        self.get_logger().info(response.message)
        return response

    def _reset(self) -> None:
        self._pipeline.reset()
        self._odometry.clear()
        self._cameras.clear()
        self._counters.clear()
        self._dropped_before = self._worker.stats().dropped
        self._latency_ms.clear()
        self._work_ms.clear()
        self._last = None

    async def _on_worker(self, function: Callable[[], None], text: str) -> tuple[bool, str]:
        """Run on the worker's thread between two frames; (success, message)."""
        answer = self._new_future()

        def report(done: ThreadFuture[Any]) -> None:
            error = done.exception()
            self._resolve(answer, (False, str(error)) if error else (True, text))

        self._worker.call(function).add_done_callback(report)
        success, message = await answer
        return success, message

    def _new_future(self) -> Future:
        return Future(executor=self.executor)

    def _resolve(self, answer: Future, value: tuple[bool, str]) -> None:
        answer.set_result(value)
        # rclpy polls awaiting callbacks only when something wakes the executor
        if (executor := self.executor) is not None:
            executor.wake()

    # --- the worker's thread ---

    def _handle(self, message: ImageMessage) -> None:
        begin = time.monotonic()
        try:
            outcome = self._pipeline.process(message, self._now_ns())
        except Exception as error:  # a defect must not end the stream, nor go unseen
            self._error("failed", f"a frame failed: {error}\n{traceback.format_exc()}")
            outcome = Outcome("failed", f"{type(error).__name__}: {error}", "failed")
        self._counters.add(outcome.name)
        if outcome.result is not None:
            self._rate_out.tick()
            self._work_ms.add((time.monotonic() - begin) * 1e3)
        self._publish(message, outcome)
        self._tell(outcome)
        self._last = outcome

    def _publish(self, message: ImageMessage, outcome: Outcome) -> None:
        header = Header(stamp=message.header.stamp, frame_id=self._settings["map_frame"])
        name = f"{self.get_fully_qualified_name().lstrip('/')}: frame"
        if outcome.result is None:
            self._status_publisher.publish(
                diagnostics.refused_status(header, name, outcome.name, outcome.reason)
            )
            return
        self._publish_pose(header, outcome, self._pipeline.camera_frame(message))
        latency_ms = self._latency_of(message)
        if latency_ms is not None:
            self._latency_ms.add(latency_ms)
        self._status_publisher.publish(
            diagnostics.frame_status(header, name, outcome.result, latency_ms)
        )
        if self._overlay_publisher.get_subscription_count() > 0:
            self._publish_overlay(message, outcome)

    def _publish_pose(self, header: Header, outcome: Outcome, camera_frame: str) -> None:
        assert outcome.result is not None and outcome.frame is not None
        T_map_cam, covariance = outcome.result.T_map_cam, outcome.result.covariance
        if T_map_cam is None:
            return  # lost: the status says so, and no pose is published
        T_base_cam = self._settings.T_base_cam
        T_map_x = T_map_cam
        if T_base_cam is not None:
            T_map_x = convert.base_from_camera(T_map_cam, T_base_cam)
        self._pose_publisher.publish(convert.pose_stamped(T_map_x, header))
        if covariance is not None:
            moved = convert.moved_covariance(covariance, T_map_cam, T_map_x)
            self._covariance_publisher.publish(
                convert.pose_with_covariance(T_map_x, moved, header)
            )
        if self._tf_publisher is not None:
            self._publish_tf(T_map_cam, header, outcome.frame.stamp_ns, camera_frame)

    def _publish_tf(self, T_map_cam: Any, header: Header, stamp_ns: int, camera: str) -> None:
        from tf2_msgs.msg import TFMessage

        settings = self._settings
        T_odom_cam = self._odometry.at(stamp_ns)
        if settings["odom_topic"] and T_odom_cam is None:
            self._warn("tf:odometry", "no odometry at the image's time: no /tf is published")
            return  # map->base would give the base a second parent
        frames = Frames(settings["odom_frame"], settings["base_frame"], camera)
        transform = map_transform(T_map_cam, frames, settings.T_base_cam, T_odom_cam)
        stamped = convert.transform_to_ros(transform.T_map_child, header, transform.child)
        assert self._tf_publisher is not None
        self._tf_publisher.publish(TFMessage(transforms=[stamped]))

    def _publish_overlay(self, message: ImageMessage, outcome: Outcome) -> None:
        frame, result, tracker = outcome.frame, outcome.result, self._pipeline.tracker
        assert frame is not None and result is not None and tracker is not None
        camera = frame.camera.scaled_to_fit(self._settings.config.image.max_side)
        image = cv2.resize(frame.image, (camera.width, camera.height))
        live, pinhole = camera.undistort(image)  # type: ignore[arg-type]
        render = None
        if result.T_map_cam is not None:
            rgb, _, alpha = tracker.localizer.render(pinhole, result.T_map_cam)
            render = overlay.in_colours_of(live, rgb, alpha)
        picture = overlay.compare(live, render, self._settings["overlay_mode"])
        picture = overlay.captioned(picture, overlay.caption(result), result.ok)
        header = Header(stamp=message.header.stamp, frame_id=self._pipeline.camera_frame(message))
        self._overlay_publisher.publish(convert.image_to_ros(picture, header))

    def _tell(self, outcome: Outcome) -> None:
        """Log what a user must know, each once or throttled."""
        if outcome.warning:
            self._warn(f"time:{outcome.warning[:20]}", outcome.warning)
        if outcome.name in ("rejected", "stale"):
            topic = self._image_subscription.topic_name
            self._warn(f"{outcome.name}:{outcome.key}", f"{topic}: {outcome.reason}")
        elif outcome.name == "lost":
            self._state = "lost"
            self._warn("lost", f"lost: {outcome.reason}; searching in the whole map")
        elif outcome.name == "localized":
            if self._state != "tracking":
                self.get_logger().info(f"localized after '{self._state}'")
            self._state = "tracking"

    def _now_ns(self) -> int | None:
        """The node's time; None under use_sim_time before the first /clock."""
        now_ns = int(self.get_clock().now().nanoseconds)
        return now_ns if now_ns > 0 else None

    def _latency_of(self, message: ImageMessage) -> float | None:
        """Milliseconds from the image's stamp until now, None where the clocks do not agree."""
        now_ns = self._now_ns()
        if now_ns is None:
            return None
        latency_ms = (now_ns - convert.stamp_to_ns(message.header.stamp)) * 1e-6
        return latency_ms if 0 <= latency_ms < 60_000 else None

    # --- once a second ---

    def _on_tick(self) -> None:
        self._watch_inputs()
        header = Header(stamp=self.get_clock().now().to_msg())
        name = f"{self.get_fully_qualified_name().lstrip('/')}: localization"
        level, state = self._level_and_state()
        self._diagnostics_publisher.publish(
            diagnostics.summary(header, name, level, state, self._diagnostic_values(state))
        )

    def _watch_inputs(self) -> None:
        silent_s = time.monotonic() - self._last_image
        if self.get_parameter("use_sim_time").value and self._now_ns() is None:
            self._warn("clock", "use_sim_time is set, but nothing is heard on /clock")
        if silent_s < self._settings["no_data_warning_s"] or self._paused:
            return
        image, info = self._image_subscription.topic_name, self._info_subscription.topic_name
        self._warn(
            "no_data",
            f"no image for {silent_s:.0f} s. {image} has {self.count_publishers(image)} "
            f"publishers, {self._counters.snapshot()['received']} images received; {info} has "
            f"{self.count_publishers(info)} publishers, valid: {self._cameras}",
        )

    def _level_and_state(self) -> tuple[bytes, str]:
        if self._paused:
            return DiagnosticStatus.WARN, "paused"
        if self._pipeline.tracker is None:
            return DiagnosticStatus.ERROR, self._state
        if time.monotonic() - self._last_image >= self._settings["no_data_warning_s"]:
            return DiagnosticStatus.WARN, "no images"
        if self._last is not None and self._last.name in ("rejected", "stale", "failed"):
            return DiagnosticStatus.ERROR, f"{self._last.name}: {self._last.reason}"
        tracking = self._state == "tracking"
        return (DiagnosticStatus.OK if tracking else DiagnosticStatus.WARN), self._state

    def _diagnostic_values(self, state: str) -> dict[str, Any]:
        result = self._last.result if self._last is not None else None
        age_ms = self._last.age_ms if self._last is not None else None
        counts = self._counters.snapshot()
        counts["dropped"] = self._worker.stats().dropped - self._dropped_before
        return {
            "state": state,
            "map": self._map_name,
            "rate_in_hz": f"{self._rate_in.hz():.2f}",
            "rate_out_hz": f"{self._rate_out.hz():.2f}",
            "latency_ms_p50": f"{self._latency_ms.percentile(50):.1f}",
            "latency_ms_p95": f"{self._latency_ms.percentile(95):.1f}",
            "work_ms_p50": f"{self._work_ms.percentile(50):.1f}",
            "work_ms_p95": f"{self._work_ms.percentile(95):.1f}",
            "image_age_ms": "" if age_ms is None else f"{age_ms:.1f}",
            "inliers": 0 if result is None else result.inliers,
            "frames_processed": counts["localized"] + counts["lost"],
            **{f"frames_{name}": count for name, count in counts.items()},
            "rss_mb": f"{diagnostics.resident_mb():.0f}",
        }

    # --- the end ---

    def stop(self, timeout_s: float = _SHUTDOWN_S) -> bool:
        """Finish the frame at hand and end the threads; False where one still runs."""
        self._stopping = True
        deadline = time.monotonic() + timeout_s
        stopped = self._worker.stop(timeout_s)
        if self._loader is not None:
            self._loader.join(max(0.0, deadline - time.monotonic()))
            stopped = stopped and not self._loader.is_alive()
        logging.getLogger("igaussian_core").removeHandler(self._log_bridge)
        return stopped


class _LogBridge(logging.Handler):
    """What the core logs, on the node's logger."""

    def __init__(self, node: Node) -> None:
        super().__init__(logging.INFO)
        self._logger = node.get_logger()

    def emit(self, record: logging.LogRecord) -> None:
        text = self.format(record)
        # rclpy ties a severity to each calling line
        if record.levelno >= logging.ERROR:
            self._logger.error(text)
        elif record.levelno >= logging.WARNING:
            self._logger.warning(text)
        else:
            self._logger.info(text)


def _bridge_logging(node: Node) -> _LogBridge:
    bridge = _LogBridge(node)
    logger = logging.getLogger("igaussian_core")
    logger.addHandler(bridge)
    logger.setLevel(logging.INFO)
    return bridge


class _Run:
    """What ends the node: a signal, or a map that cannot be loaded at start."""

    def __init__(self) -> None:
        self.over = threading.Event()
        self.failure = ""

    def on_signal(self, number: int, _: Any) -> None:
        self.over.set()

    def on_failure(self, text: str) -> None:
        if not self.over.is_set():
            self.failure = text
        self.over.set()


def main(args: list[str] | None = None) -> int:
    """Run the node until SIGINT or SIGTERM; 0 then, 1 where it cannot start."""
    run = _Run()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, run.on_signal)
    try:
        # rclpy's own handlers end the context while the worker may still publish
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
        node = LocalizerNode()
    except (IGaussianError, RuntimeError, ValueError) as error:
        print(f"localizer: {' '.join(str(error).split())}", file=sys.stderr)
        rclpy.try_shutdown()
        return 1
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    _check_map_path(node, run)
    if not run.over.is_set():
        node.start(run.on_failure)
    _spin(executor, node, run)
    if run.failure:
        node.get_logger().fatal(run.failure)
    # this order, or the process may end with SIGABRT: worker, executor, node, context
    stopped = node.stop()
    executor.shutdown()
    node.destroy_node()
    rclpy.try_shutdown()
    status = 1 if run.failure else 0
    if not stopped:
        print("localizer: a thread is still busy; ending without it", file=sys.stderr)
        sys.stderr.flush()
        os._exit(status)
    return status


def _check_map_path(node: LocalizerNode, run: _Run) -> None:
    """Say at once what opening the map would say after seconds."""
    path = node.map_path()
    if not path:
        run.on_failure("parameter map_path is empty: set it to a compiled map (.igmap directory)")
    elif not Path(path).exists():
        run.on_failure(f"parameter map_path: {path} does not exist")


def _spin(executor: SingleThreadedExecutor, node: LocalizerNode, run: _Run) -> None:
    """Callbacks until the run is over; an error in one does not end the node."""
    guard = Throttle(lambda text: node.get_logger().error(text))
    while not run.over.is_set():
        try:
            # Python sees signals between two calls only
            executor.spin_once(timeout_sec=0.1)
        except TimeoutException:
            continue
        except Exception as error:
            guard(repr(error), f"a callback failed: {traceback.format_exc()}")


if __name__ == "__main__":
    sys.exit(main())
