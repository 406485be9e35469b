"""The bundled drive through the node over DDS: accuracy against truth, stamps."""

from __future__ import annotations

import time

import numpy as np
import pytest
from harness import Spinning, node_process, replay_process, wait_until

from igaussian_core.bags import Bag
from igaussian_core.compile_map import compile_map
from igaussian_ros.diagnostics import OUTCOMES
from igaussian_ros.listener import Listener

SECONDS = 10


@pytest.fixture(scope="module")
def demo(repo_root, tmp_path_factory):
    """Folder of the recording, and the compiled map of its room."""
    folder = repo_root / "bags" / "demo"
    target = tmp_path_factory.mktemp("demo") / "room.igmap"
    compile_map(folder / "room.ply", target, folder / "mapping_cameras.json")
    return folder / "drive", target


def test_the_bundled_drive_is_localized_over_dds(ros, demo, tmp_path):
    bag, map_path = demo
    with Bag(bag) as recording:
        image_stamps = {frame.stamp_ns for frame in recording.frames()}
        true_stamps = {stamp_ns for stamp_ns, _ in recording.poses("/ground_truth/pose")}
    assert image_stamps <= true_stamps

    listener = Listener(name="demo_listener")
    with Spinning(listener), node_process(
        tmp_path, map_path=map_path, image_transport="compressed", use_sim_time=True
    ) as node:
        assert node.says("loaded in", 60), node.log
        arguments = ["--duration", str(SECONDS), "--wait-for-subscribers", "10"]
        with replay_process(tmp_path, bag, *arguments) as player:
            assert player.popen.wait(90) == 0, player.log
        time.sleep(2.5)  # the last frame, and diagnostics that tell of it
        counts = {n: int(listener.diagnostics[f"frames_{n}"]) for n in ("received", *OUTCOMES)}
        assert counts["received"] == sum(counts[name] for name in OUTCOMES), counts
        assert wait_until(lambda: len(listener.poses) == counts["localized"], 5)
        processed = counts["localized"] + counts["lost"]
        assert processed >= 5 and counts["lost"] <= max(1, 0.05 * processed), counts
        assert {pose.stamp_ns for pose in listener.poses} <= image_stamps
        assert {pose.frame for pose in listener.poses} == {"map"}

        errors = np.array(listener.errors())
        assert len(errors) == len(listener.poses)
        assert (np.median(errors, 0) <= [0.3, 0.02]).all(), errors
        assert (errors.max(0) <= [2.0, 0.10]).all(), errors
        assert node.end() == 0, node.log
