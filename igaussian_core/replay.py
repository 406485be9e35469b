"""Localize a recording without ROS: the node's worker and tracker, fed by a clock of its own."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from igaussian_core.bags import IMAGES, ODOMETRY, Bag, T_from_chain
from igaussian_core.config import Config
from igaussian_core.errors import BagError
from igaussian_core.frame import Frame
from igaussian_core.localizer import Localizer
from igaussian_core.result import LocalizationResult
from igaussian_core.tracker import Tracker
from igaussian_core.worker import NewestFrameWorker, WorkerStats

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ReplayedFrame:
    """One localized frame.

    Attributes:
        latency_ms: from the frame's time in the replay to the end of work on it.
        finished_s: wall time since the replay began.
    """

    frame: Frame
    result: LocalizationResult
    latency_ms: float
    finished_s: float


def replay(
    bag: Bag,
    localizer: Localizer,
    config: Config,
    on_frame: Callable[[ReplayedFrame], None],
    rate: float = 1.0,
    duration_s: float | None = None,
    every_frame: bool = False,
    stop: threading.Event | None = None,
    topics: tuple[str | None, str | None] = (None, None),
) -> WorkerStats:
    """Localize the frames of a bag as a robot would have: the newest whenever work ends.

    Odometry is used where the bag has it with static transforms to the camera.

    Args:
        on_frame: called on the worker's thread with every processed frame.
        rate: 2.0 plays twice as fast.
        duration_s: play so much of the bag only.
        every_frame: process each frame however long it takes; nothing is dropped.
        stop: ends the replay when set.
        topics: of image and camera_info; None: found in the bag.

    Raises:
        BagError: see Bag.frames.
    """
    tracker = Tracker(localizer, config)
    odometry = deque(camera_odometry(bag, topics[0]))
    begin = time.monotonic()
    begin_ns: int | None = None

    def handle(frame: Frame) -> None:
        result = tracker.process(frame)
        assert begin_ns is not None
        elapsed_s = time.monotonic() - begin
        due_s = (frame.stamp_ns - begin_ns) * 1e-9 / rate
        on_frame(ReplayedFrame(frame, result, (elapsed_s - due_s) * 1e3, elapsed_s))

    stop = stop or threading.Event()
    worker: NewestFrameWorker[Frame] = NewestFrameWorker(handle)
    try:
        for frame in bag.frames(*topics, skip_bad=True):
            if begin_ns is None:
                begin, begin_ns = time.monotonic(), frame.stamp_ns
            offset_s = (frame.stamp_ns - begin_ns) * 1e-9
            if duration_s is not None and offset_s > duration_s:
                break
            if every_frame:
                worker.drain(600.0)
            elif stop.wait(max(0.0, begin + offset_s / rate - time.monotonic())):
                break
            if stop.is_set():
                break
            while odometry and odometry[0][0] <= frame.stamp_ns:
                tracker.add_odometry(*odometry.popleft())
            worker.submit(frame)
        worker.drain(60.0)
    finally:
        worker.stop()
    return worker.stats()


def camera_odometry(bag: Bag, image_topic: str | None = None) -> list[tuple[int, Array]]:
    """(stamp_ns, T_odom_cam) of a bag; empty where it has no odometry of the camera's robot."""
    if len(bag.topics_of(ODOMETRY)) != 1:
        return []
    odometry = bag.odometry()
    if not odometry:
        return []
    T_base_cam = camera_mounting(bag, odometry[0].child, image_topic)
    if T_base_cam is None:
        return []
    return [(item.stamp_ns, item.T_frame_child @ T_base_cam) for item in odometry]


def camera_mounting(bag: Bag, base_frame: str, image_topic: str | None = None) -> Array | None:
    """T_base_cam of the camera's optical frame by the bag's static transforms, or None."""
    frame = camera_frame(bag, image_topic)
    return T_from_chain(bag.static_transforms(), base_frame, frame)


def camera_frame(bag: Bag, image_topic: str | None = None) -> str:
    """frame_id of the first image.

    Raises:
        BagError: no image.
    """
    topic = image_topic or bag.image_topic()
    if bag.topics[topic].type not in IMAGES:
        raise BagError(f"{bag.path}: {topic} holds no images")
    for _, message in bag.read((topic,)):
        return str(message.header.frame_id)
    raise BagError(f"{bag.path}: no image on {topic}")

