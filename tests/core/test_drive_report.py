"""Report and recording of a drive that is made up here."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest
from matplotlib.collections import EllipseCollection

from igaussian_core.bags import Bag
from igaussian_core.evaluate.drive import DriveFrame, MemorySample, Trajectory, summarize_drive
from igaussian_core.evaluate.drive_overlays import Overlay
from igaussian_core.evaluate.drive_recording import write_recording
from igaussian_core.evaluate.drive_report import (
    Drive,
    _trajectory_figure,
    missed,
    plain,
    plan_axes,
    write_report,
)
from igaussian_core.views import look_at

START = 1_700_000_000_000_000_000
STEP = 100_000_000


def _poses(count: int = 20) -> list[np.ndarray]:
    return [look_at([math.cos(a), math.sin(a), 1.2], [0, 0, 1.0]) for a in np.linspace(0, 5, count)]


def _frames(poses: list[np.ndarray], lost: tuple[int, ...] = (4,)) -> list[DriveFrame]:
    frames = []
    for i, T in enumerate(poses):
        estimate = T.copy()
        estimate[0, 3] += 0.01
        good = i not in lost
        frames.append(
            DriveFrame(
                START + i * STEP, i * 0.1, "ok" if good else "too_few_matches", "<why>",
                estimate if good else None, T, 100, 200.0 if good else math.nan, i * 0.3,
                {"match": 90.0, "render": 10.0, "total": 100.0},
            )
        )  # fmt: skip
    return frames


def _drive(frames: list[DriveFrame], poses: list[np.ndarray], **limits: float) -> Drive:
    memory = [MemorySample(0.5 * i, 300.0) for i in range(10)]
    picture = np.full((48, 64, 3), 90, np.uint8)
    overlays = [Overlay(picture, picture + 60, frames[0])]
    truth = Trajectory([(START + i * STEP, T) for i, T in enumerate(poses)])
    points = np.random.default_rng(0).normal(0, 3, (5000, 3)).astype(np.float32)
    figures = summarize_drive(frames, 25, memory)
    facts = {"recording": "<a&b>"}
    return Drive("A <drive>", figures, frames, truth, memory, points, overlays, limits, facts)


class _Sources(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.links: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.links += [value or "" for name, value in attrs if name in ("src", "href")]

    def handle_data(self, data: str) -> None:
        self.text += data


def test_the_page_needs_no_other_file(tmp_path: Path) -> None:
    poses = _poses()
    page = write_report(_drive(_frames(poses), poses), tmp_path / "report")
    sources = _Sources()
    sources.feed(page.read_text())
    assert len(sources.links) == 3 + 3  # plots, and one overlay's three pictures
    assert all(re.match("data:image/(png|jpeg);base64,", link) for link in sources.links)
    assert "A <drive>" in sources.text and "<a&b>" in sources.text  # escaped in the source
    assert "19 of 20 processed frames localized, 25 images played" in sources.text
    assert "1.00\xa0cm" in sources.text


def test_pictures_and_figures_on_disk(tmp_path: Path) -> None:
    poses = _poses()
    drive = _drive(_frames(poses), poses)
    write_report(drive, tmp_path)
    for name in ("trajectory", "errors", "latency"):
        picture = cv2.imread(str(tmp_path / f"{name}.png"))
        assert picture.shape[1] > 800 and picture.std() > 5, name
    assert cv2.imread(str(tmp_path / "overlay_0.png")).shape == (48, 128, 3)
    written = json.loads((tmp_path / "summary.json").read_text())
    assert written == plain(drive.figures)
    assert written["accepted"] == 19 and written["median_error_m"] == pytest.approx(0.01)


def test_the_plan_shows_how_sure_positions_are() -> None:
    """Ellipses 95 % of a position twice as uncertain along x, as large as the legend says."""
    poses = _poses()
    covariance = np.diag([4e-6, 1e-6, 1e-6, 1e-8, 1e-8, 1e-8])
    known = [dataclasses.replace(f, covariance=covariance) for f in _frames(poses)]
    for frames, expected in ((known, 1), (_frames(poses), 0)):
        axis = _trajectory_figure(_drive(frames, poses)).axes[0]
        drawn = [c for c in axis.collections if isinstance(c, EllipseCollection)]
        assert len(drawn) == expected
    (ellipses,) = (
        c for c in _trajectory_figure(_drive(known, poses)).axes[0].collections
        if isinstance(c, EllipseCollection)
    )  # fmt: skip
    assert len(ellipses.get_offsets()) == 19
    sizes = np.sort(np.column_stack([ellipses.get_widths(), ellipses.get_heights()]), axis=1)
    np.testing.assert_allclose(sizes[:, 1], 2 * sizes[:, 0])


def test_a_drive_without_any_pose(tmp_path: Path) -> None:
    poses = _poses()
    drive = _drive(_frames(poses, lost=tuple(range(20))), poses)
    text = write_report(drive, tmp_path).read_text()
    assert "0 of 20 processed frames" in text
    assert json.loads((tmp_path / "summary.json").read_text())["median_error_m"] is None


def test_missed_limits_are_named_and_marked(tmp_path: Path) -> None:
    figures = {"accepted_ratio": 0.9, "max_error_m": 0.01, "rate_hz": math.nan}
    limits = {"accepted_ratio": 0.95, "max_error_m": 0.1, "rate_hz": 2.9}
    assert missed(figures, limits) == [
        "accepted_ratio = 0.9, wanted >= 0.95", "rate_hz = nan, wanted >= 2.9"
    ]  # fmt: skip
    assert missed({**figures, "accepted_ratio": 0.95, "rate_hz": 3.0}, limits) == []
    poses = _poses()
    page = write_report(_drive(_frames(poses), poses, median_error_m=0.001), tmp_path)
    assert page.read_text().count("class='card bad'") == 1


def test_plan_of_upright_and_of_turned_maps() -> None:
    right, ahead, up, names = plan_axes(_poses())
    np.testing.assert_allclose([right, ahead, up], np.eye(3))
    assert names == ("x [m]", "y [m]")
    turn = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])  # z up to y up
    right, ahead, up, names = plan_axes([turn @ T for T in _poses()])
    np.testing.assert_allclose(up, turn[:3, :3] @ [0, 0, 1], atol=0.2)
    np.testing.assert_allclose(np.cross(right, ahead), up, atol=1e-9)
    assert names[0] == "right [m]"


def test_overlay_tiles_alternate() -> None:
    frame = _frames(_poses())[0]
    live, render = np.zeros((16, 16, 3), np.uint8), np.full((16, 16, 3), 255, np.uint8)
    overlay = Overlay(live, render, frame)
    assert overlay.side_by_side().shape == (16, 32, 3)
    tiles = overlay.checkered(4)[::4, ::4, 0]
    expected = np.indices((4, 4)).sum(0) % 2 * 255
    np.testing.assert_array_equal(tiles, expected)


def test_recording(tmp_path: Path) -> None:
    poses = _poses()
    drive = _drive(_frames(poses), poses)
    write_recording(tmp_path / "rec", drive.frames, drive.truth, drive.overlays)
    with Bag(tmp_path / "rec") as bag:
        counts = {name: topic.count for name, topic in bag.topics.items()}
        assert counts == {
            "/ground_truth/path": 1, "/ground_truth/pose": 20, "/localizer/overlay/compressed": 1,
            "/localizer/path": 19, "/localizer/pose": 19, "/localizer/status": 20, "/tf": 19,
        }  # fmt: skip
        written = bag.poses("/localizer/pose")
        accepted = [(f.stamp_ns, f.T_map_cam) for f in drive.frames if f.T_map_cam is not None]
        assert [stamp for stamp, _ in written] == [stamp for stamp, _ in accepted]
        np.testing.assert_allclose([T for _, T in written], [T for _, T in accepted], atol=1e-9)
        statuses = [message.status[0] for _, message in bag.read(["/localizer/status"])]
        assert [s.level for s in statuses].count(1) == 1 and statuses[4].message == "<why>"
        *_, (_, last_path) = bag.read(["/localizer/path"])
        assert len(last_path.poses) == 19
