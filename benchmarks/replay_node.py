"""Figures of a recording replayed through the node over DDS, both in processes of their own.

    python benchmarks/replay_node.py BAG --map MAP.igmap [--rate 1.0] [--raw] [--odometry]

Stamps are moved to the present, so that a latency is wall time from an image's stamp to the
arrival of its pose at a third process, transport included. Prints one JSON object.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor

from igaussian_core.bags import Bag, T_from_chain
from igaussian_core.geometry import inverse
from igaussian_ros.convert import pose_to_ros
from igaussian_ros.listener import Listener

ROOT = Path(__file__).resolve().parents[1]
PROFILE = ROOT / "msg_configs" / "fastdds_large_images.xml"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("bag")
    parser.add_argument("--map", required=True, dest="map_path")
    parser.add_argument("--rate", type=float, default=1.0)
    parser.add_argument("--loop", type=int, default=1)
    parser.add_argument("--raw", action="store_true", help="raw images over DDS, not JPEG")
    parser.add_argument("--stamp", choices=("now", "bag"), default="now")
    parser.add_argument("--param", action="append", default=[], metavar="NAME:=VALUE")
    parser.add_argument(
        "--odometry", action="store_true", help="use /odom, and base_to_camera of /tf_static"
    )
    parser.add_argument("--errors", action="store_true", help="list every pose's error")
    parser.add_argument(
        "--judge-every", type=int, default=1, metavar="N",
        help="judge every Nth image only, from the first (needs --stamp bag)",
    )  # fmt: skip
    options = parser.parse_args()
    if options.judge_every > 1 and options.stamp != "bag":
        parser.error("--judge-every needs --stamp bag")

    os.environ.setdefault("ROS_DOMAIN_ID", str(20 + os.getpid() % 80))
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("FASTRTPS_DEFAULT_PROFILES_FILE", str(PROFILE))
    os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])

    options.T_base_cam = _extrinsic(options.bag) if options.odometry else None
    rclpy.init(args=[])
    listener = Listener()
    executor = SingleThreadedExecutor()
    executor.add_node(listener)
    spinner = threading.Thread(target=_spin, args=(executor,))
    spinner.start()
    node = subprocess.Popen(_node_command(options), start_new_session=True)
    try:
        _wait(lambda: listener.diagnostics.get("map", "") != "", 120, node)
        subprocess.run(_replay_command(options), check=True)
        time.sleep(2.5)  # the last frames, and diagnostics of them
        figures = _figures(listener, options.T_base_cam, _judged_stamps(options))
    finally:
        node.send_signal(signal.SIGINT)
        try:
            status = node.wait(20)
        except subprocess.TimeoutExpired:
            node.kill()
            status = node.wait()
        executor.shutdown()
        spinner.join()
        listener.destroy_node()
        rclpy.try_shutdown()
    figures["node_exit_status"] = status
    if options.errors:
        for pose, (degrees, metres) in zip(listener.poses, listener.errors(), strict=False):
            print(f"{pose.stamp_ns} {degrees:.3f} deg {metres * 100:.2f} cm", file=sys.stderr)
    print(json.dumps(figures, indent=1))
    return 0


def _extrinsic(bag: str) -> np.ndarray:
    """T_base_cam of the recording's /tf_static."""
    with Bag(bag) as recording:
        T = T_from_chain(recording.static_transforms(), "base_link", "camera_optical_frame")
    if T is None:
        raise SystemExit(f"{bag}: no transform base_link -> camera_optical_frame in /tf_static")
    return T


def _spin(executor: SingleThreadedExecutor) -> None:
    with contextlib.suppress(ExternalShutdownException):
        executor.spin()


def _node_command(options: argparse.Namespace) -> list[str]:
    parameters = [
        f"map_path:={options.map_path}",
        f"image_transport:={'raw' if options.raw else 'compressed'}",
        f"use_sim_time:={str(options.stamp == 'bag').lower()}",
        *options.param,
    ]
    if options.T_base_cam is not None:
        message = pose_to_ros(options.T_base_cam)
        t, q = message.position, message.orientation
        parameters.append(f"base_to_camera:={[t.x, t.y, t.z, q.x, q.y, q.z, q.w]}")
        parameters.append("odom_topic:=/odom")
    command = [sys.executable, "-m", "igaussian_ros.localizer_node", "--ros-args"]
    return command + [word for parameter in parameters for word in ("-p", parameter)]


def _replay_command(options: argparse.Namespace) -> list[str]:
    command = [sys.executable, "-m", "igaussian_ros.replay", options.bag]
    command += ["--stamp", options.stamp, "--rate", str(options.rate), "--loop", str(options.loop)]
    return command + ["--wait-for-subscribers", "10"] + (["--raw"] if options.raw else [])


def _wait(condition, timeout_s: float, node: subprocess.Popen) -> None:  # type: ignore[no-untyped-def,type-arg]
    end = time.monotonic() + timeout_s
    while not condition():
        if node.poll() is not None or time.monotonic() > end:
            raise SystemExit("the node did not come up")
        time.sleep(0.1)


def _judged_stamps(options: argparse.Namespace) -> set[int] | None:
    """Stamps of the images to judge; None: all."""
    if options.judge_every == 1:
        return None
    with Bag(options.bag) as recording:
        return {f.stamp_ns for f in list(recording.frames())[:: options.judge_every]}


def _figures(
    listener: Listener, T_base_cam: np.ndarray | None, judged: set[int] | None
) -> dict[str, float | int | str]:
    poses, diagnostics = listener.poses, listener.diagnostics
    T_cam_base = None if T_base_cam is None else inverse(T_base_cam)
    if judged is not None:
        listener.poses = [pose for pose in poses if pose.stamp_ns in judged]
    errors = np.array(listener.errors(T_cam_base)).reshape(-1, 2)
    latencies = [pose.latency_ms for pose in poses]
    span_s = (poses[-1].received_ns - poses[0].received_ns) * 1e-9 if len(poses) > 1 else 0.0
    processed = sum("inliers" in status.values for status in listener.statuses)

    def percentile(values: list[float] | np.ndarray, q: float) -> float:
        return round(float(np.percentile(values, q)), 4) if len(values) else float("nan")

    counts = {k: int(v) for k, v in diagnostics.items() if k.startswith("frames_")}
    return {
        "processed": processed,
        "accepted": len(poses),
        "true_poses": len(listener.truth),
        "judged": len(errors),
        "median_error_m": percentile(errors[:, 1], 50),
        "median_error_deg": percentile(errors[:, 0], 50),
        "max_error_m": percentile(errors[:, 1], 100),
        "max_error_deg": percentile(errors[:, 0], 100),
        "rate_hz": round((len(poses) - 1) / span_s, 3) if span_s else 0.0,
        "latency_ms_p50": percentile(latencies, 50),
        "latency_ms_p95": percentile(latencies, 95),
        "latency_ms_max": percentile(latencies, 100),
        "work_ms_p50": diagnostics.get("work_ms_p50", ""),
        "work_ms_p95": diagnostics.get("work_ms_p95", ""),
        "rss_mb": diagnostics.get("rss_mb", ""),
        **counts,
    }


if __name__ == "__main__":
    sys.exit(main())
