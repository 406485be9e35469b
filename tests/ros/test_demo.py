"""`igaussian demo` as a user starts it: the real node, DDS, figures, report, recording."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from harness import ROOT, wait_until
from rich.console import Console
from scene import START_NS, STEP_NS

from igaussian_core.bags import Bag
from igaussian_core.config import Config
from igaussian_core.evaluate.drive import Trajectory
from igaussian_core.geometry import compose, pose_error
from igaussian_core.map_package import open_package
from igaussian_ros import demo
from igaussian_ros.demo_ride import Topics, _Watch, find_topics, node_arguments

KEYS = {
    "processed", "accepted", "median_error_m", "median_error_deg", "max_error_m", "max_error_deg",
    "rate_hz", "latency_ms_p50", "latency_ms_p95", "rss_mb",
}  # fmt: skip


def _demo(folder: Path, *arguments: object) -> tuple[dict[str, float], str]:
    """Figures and output of the command."""
    figures = folder / "figures.json"
    command = [sys.executable, "-m", "igaussian_core.cli", "demo", "--json", figures]
    command += ["--work-dir", folder / "out", *arguments]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [str(part) for part in command], cwd=folder, env=environment, text=True, timeout=300,
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        start_new_session=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-4000:]
    return json.loads(figures.read_text()), done.stdout


def _processes_with(text: str) -> list[int]:
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            if text.encode() in path.read_bytes():
                found.append(int(path.parent.name))
        except OSError:
            continue
    return found


def test_over_dds(corner, tmp_path: Path) -> None:
    figures, output = _demo(tmp_path, "--bag", corner.bag, "--map", corner.map_path)
    assert set(figures) >= KEYS
    assert figures["sent"] == 40 and figures["accepted"] >= 3
    assert figures["accepted_ratio"] >= 0.95
    assert figures["median_error_m"] < 0.02 and figures["median_error_deg"] < 0.3
    assert figures["max_error_m"] < 0.10 and figures["max_error_deg"] < 2.0
    assert 0 < figures["latency_ms_p50"] <= figures["latency_ms_p95"] < 60_000
    assert 50 < figures["rss_mb"] < 1500
    assert "over DDS" in output and "red" not in output
    folder = tmp_path / "out" / "demo"
    for name in ("report.html", "trajectory.png", "errors.png", "latency.png", "overlay_0.png"):
        assert (folder / name).stat().st_size > 5000, name
    assert "localized after" in (folder / "localizer.log").read_text()
    _check_recording(folder / "recording", corner.poses, int(figures["accepted"]))
    assert not _processes_with(str(corner.map_path)), "the node still runs"


def _check_recording(path: Path, poses: list[np.ndarray], accepted: int) -> None:
    """Poses carry the images' own stamps and lie where the camera was then."""
    with Bag(path) as bag:
        written = bag.poses("/localizer/pose")
        assert len(written) == accepted == bag.topics["/localizer/path"].count
        assert bag.topics["/localizer/overlay/compressed"].count > 0
    stamps = [stamp for stamp, _ in written]
    assert len(set(stamps)) == len(stamps)
    for stamp, T_map_cam in written:
        index, rest = divmod(stamp - START_NS, STEP_NS)
        assert rest == 0
        angle, distance = pose_error(T_map_cam, poses[index])
        assert angle < 2.0 and distance < 0.10


def test_nothing_is_left_running_when_the_demo_is_ended(corner, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "igaussian_core.cli", "demo", "--rate", "0.1"]
    command += ["--bag", str(corner.bag), "--map", str(corner.map_path)]
    log = tmp_path / "demo.log"
    with log.open("wb") as stream:
        process = subprocess.Popen(
            command, cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)},
            stdin=subprocess.DEVNULL, stdout=stream, stderr=subprocess.STDOUT,
            start_new_session=True,
        )  # fmt: skip
    try:
        assert wait_until(lambda: "replaying over DDS" in log.read_text(), 60), log.read_text()
        assert len(_processes_with(str(corner.map_path))) == 2  # the demo and its node
        process.send_signal(signal.SIGTERM)
        assert process.wait(30) != 0
    finally:
        process.kill()
    assert not _processes_with(str(corner.map_path))
    assert not _processes_with(str(corner.bag))


def test_without_ros(corner, tmp_path: Path) -> None:
    figures, output = _demo(
        tmp_path, "--bag", corner.bag, "--map", corner.map_path, "--no-ros", "--duration", 2
    )
    assert "without ROS (asked for)" in output
    assert figures["sent"] == 20 or figures["sent"] == 21
    # two seconds from the first image on, not from the first message: one image more may fit
    assert 1 <= figures["accepted"] <= figures["processed"] <= figures["sent"] + 1
    assert figures["max_error_m"] < 0.10


def test_the_bundled_drive(tmp_path: Path) -> None:
    """The first seconds of it; the whole is `make demo`."""
    if not (ROOT / "bags" / "demo" / "drive").is_dir():
        pytest.skip("no bundled demo in this checkout")
    figures, output = _demo(tmp_path, "--duration", 4)
    assert figures["accepted_ratio"] >= 0.95
    assert figures["median_error_m"] < 0.02 and figures["median_error_deg"] < 0.3
    assert figures["max_error_m"] < 0.10 and figures["max_error_deg"] < 2.0
    # odometry of the base and the static transforms lead to the camera
    assert "over DDS" in output


def test_a_bad_bag_is_one_line(corner, tmp_path: Path) -> None:
    for arguments, cause in (
        (("--bag", tmp_path / "none"), "no such file"),
        (("--map", tmp_path / "none.igmap", "--bag", corner.bag), "no such file"),
    ):
        done = subprocess.run(
            [sys.executable, "-m", "igaussian_core.cli", "demo", *map(str, arguments)],
            cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)}, text=True, timeout=120,
            capture_output=True,
        )  # fmt: skip
        assert done.returncode == 1
        assert cause in done.stderr and "Traceback" not in done.stderr


def test_the_map_is_compiled_once_and_again_when_it_changes(
    corner, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = tmp_path / "corner.ply"
    shutil.copy(corner.map_path.parent / "corner.ply", source)
    shutil.copytree(corner.map_path, tmp_path / "out" / "corner.igmap")
    compiled: list[Path] = []
    monkeypatch.setattr(demo, "compile_map", lambda *a: compiled.append(a[0]))
    options = demo.DemoOptions(bag=corner.bag, map=source, work_dir=tmp_path / "out")
    target = demo.prepare_map(options, Console(quiet=True))
    assert compiled == [] and open_package(target).manifest.name == "corner"
    sift = dataclasses.replace(options, config=Config.from_flat({"features.matcher": "sift"}))
    demo.prepare_map(sift, Console(quiet=True))
    assert compiled == [source]
    compiled.clear()
    with source.open("ab") as file:
        file.write(b"\n")
    demo.prepare_map(options, Console(quiet=True))
    assert compiled == [source]


def test_the_node_is_told_the_topics(corner) -> None:
    with Bag(corner.bag) as bag:
        topics = find_topics(bag, None)
    assert topics.image == "/camera/image_raw/compressed" and topics.compressed
    assert topics.truth == "/ground_truth/pose"
    arguments = node_arguments(topics, corner.map_path, demo.DemoOptions())
    assert arguments[0] == "--ros-args"
    assert "image_transport:=compressed" in arguments
    assert f"map_path:={corner.map_path}" in arguments


@pytest.mark.parametrize("rate", [1.0, 2.0])
def test_recorded_stamps_are_found_though_the_robot_stood_still(rate: float) -> None:
    """Ten equal poses first: the later ones tell which of them was the first heard."""
    x = [0.0] * 10 + [0.1 * i for i in range(1, 21)]
    recorded = [(START_NS + i * STEP_NS, compose(np.eye(3), [v, 0, 0])) for i, v in enumerate(x)]
    wall_ns = 1_900_000_000_123_456_789
    moved = [wall_ns + int((stamp - START_NS) / rate) for stamp, _ in recorded]
    # the first two messages were not heard
    heard = [
        SimpleNamespace(stamp_ns=m, T=T) for m, (_, T) in zip(moved, recorded, strict=True)
    ][2:]
    watch = _Watch(
        SimpleNamespace(truth=heard, poses=[], statuses=[]),
        Topics("/i", "/c", "/t", True),
        Trajectory(recorded),
        [stamp for stamp, _ in recorded],
        rate,
        lambda frame: None,
    )
    assert [watch._recorded_stamp(m) for m in moved] == [stamp for stamp, _ in recorded]
