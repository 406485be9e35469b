"""The report of a drive: plots as PNG, and one HTML page that needs no other file."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import matplotlib
import numpy as np
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from igaussian_core.evaluate.drive import DriveFrame, MemorySample, Trajectory
from igaussian_core.evaluate.drive_overlays import Overlay
from igaussian_core.evaluate.metrics import plain
from igaussian_core.evaluate.page import (
    BLUE,
    GREY,
    ORANGE,
    RED,
    cards,
    facts_table,
    new_figure,
    number,
    page,
    pictures,
    plot,
    png,
)

Array = NDArray[np.float64]

_ELLIPSES, _ELLIPSE_SHARE = 24, 0.06  # how many, how wide of the plan
_CHI2_95 = 5.99  # of two numbers
_LEAVE_OUT = 0.02  # share of the map's points that may lie outside the plan


@dataclass(frozen=True)
class Drive:
    """Everything that a report shows.

    Attributes:
        figures: of summarize_drive.
        map_points: [N, 3] positions of the map's Gaussians in `map`.
        limits: what the figures have to reach, by name; empty: none.
        facts: what was run, by name, for the reader.
    """

    title: str
    figures: Mapping[str, float]
    frames: Sequence[DriveFrame]
    truth: Trajectory
    memory: Sequence[MemorySample]
    map_points: NDArray[np.float32]
    overlays: Sequence[Overlay]
    limits: Mapping[str, float]
    facts: Mapping[str, str]


def write_report(drive: Drive, folder: Path) -> Path:
    """Write report.html, its pictures as PNG and summary.json into a folder; the page's path."""
    folder.mkdir(parents=True, exist_ok=True)
    plots = _plots(drive)
    for name, data in plots.items():
        (folder / f"{name}.png").write_bytes(data)
    for old in folder.glob("overlay_*.png"):
        old.unlink()
    for index, overlay in enumerate(drive.overlays):
        path = folder / f"overlay_{index}.png"
        cv2.imwrite(str(path), overlay.side_by_side()[..., ::-1])
    (folder / "summary.json").write_text(json.dumps(plain(drive.figures), indent=1) + "\n")
    page = folder / "report.html"
    page.write_text(_page(drive, plots), encoding="utf-8")
    return page


def drive_page(drive: Drive) -> str:
    """The page alone, as HTML."""
    return _page(drive, _plots(drive))


def _plots(drive: Drive) -> dict[str, bytes]:
    return {
        "trajectory": png(_trajectory_figure(drive)),
        "errors": png(_error_figure(drive)),
        "latency": png(_latency_figure(drive)),
    }


def missed(figures: Mapping[str, float], limits: Mapping[str, float]) -> list[str]:
    """One line for each figure that is not within its limit; the ones of `_AT_LEAST` are floors."""
    lines = []
    for name, limit in limits.items():
        value = figures.get(name, math.nan)
        floor = name in _AT_LEAST
        if not (value >= limit if floor else value <= limit):
            lines.append(f"{name} = {value:.4g}, wanted {'>=' if floor else '<='} {limit:g}")
    return lines


_AT_LEAST = ("accepted_ratio", "rate_hz")


# --- plots ---


def plan_axes(poses: Sequence[Array]) -> tuple[Array, Array, Array, tuple[str, str]]:
    """Unit vectors right, ahead and up of a plan view, and the axes' names.

    Up is z where the cameras stand upright in the map; in a map of unknown attitude it is the
    mean up direction of the cameras.
    """
    mean_up = -np.mean([T[:3, 1] for T in poses], axis=0)
    mean_up /= np.linalg.norm(mean_up) or 1.0
    if mean_up[2] > math.cos(math.radians(25)):
        x, y, z = np.eye(3)
        return x, y, z, ("x [m]", "y [m]")
    looking = np.mean([T[:3, 2] for T in poses], axis=0)
    right = np.cross(looking, mean_up)
    if np.linalg.norm(right) < 1e-3:  # straight up or down, or all around
        right = np.cross(np.eye(3)[int(np.argmin(np.abs(mean_up)))], mean_up)
    right /= np.linalg.norm(right)
    return right, np.cross(mean_up, right), mean_up, ("right [m]", "ahead [m]")


def _trajectory_figure(drive: Drive) -> Figure:
    poses = list(drive.truth.poses) or [
        f.T_map_cam for f in drive.frames if f.T_map_cam is not None
    ]
    figure, (axis,) = new_figure(8.4, 6.4)
    if not poses:
        axis.text(0.5, 0.5, "no pose", ha="center", transform=axis.transAxes)
        return figure
    right, ahead, up, names = plan_axes(poses)
    plan = np.stack([right, ahead])
    path = np.array([T[:3, 3] for T in poses])
    _draw_map(axis, drive.map_points, plan, up, path)
    true = path @ plan.T
    if len(drive.truth):
        axis.plot(*true.T, color=GREY, linewidth=5, alpha=0.7, label="truth", zorder=3)
    size = float(np.ptp(true, axis=0).max())
    _draw_estimates(axis, drive.frames, plan, 0.05 * size)
    _draw_ellipses(axis, drive.frames, plan, size)
    axis.plot(*true[0], "o", color="black", markersize=7, zorder=6, label="start")
    axis.set(xlabel=names[0], ylabel=names[1], aspect="equal")
    axis.grid(visible=False)
    figure.legend(loc="outside upper center", ncols=4, frameon=False)
    return figure


def _draw_map(
    axis: Any, points: NDArray[np.float32], plan: Array, up: Array, path: Array
) -> None:
    """The map's Gaussians around the cameras' height, dark where many lie above another: walls."""
    if len(points) == 0:
        return
    height, flat = points @ up, points @ plan.T
    low, high = np.quantile(height, [0.02, 0.98])
    middle, reach = float(np.median(path @ up)), 0.3 * float(high - low)
    flat = flat[np.abs(height - middle) < max(reach, 1e-6)]
    if len(flat) < 100:
        flat = points @ plan.T
    low2, high2 = np.quantile(flat, [_LEAVE_OUT / 2, 1 - _LEAVE_OUT / 2], axis=0)
    own = path @ plan.T
    low2, high2 = np.minimum(low2, own.min(0)), np.maximum(high2, own.max(0))
    margin = 0.05 * (high2 - low2).max()
    low2, high2 = low2 - margin, high2 + margin
    cells = np.maximum(8, (high2 - low2) / (high2 - low2).max() * 200).astype(int)
    counts, _, _ = np.histogram2d(
        flat[:, 0], flat[:, 1], bins=tuple(cells), range=np.stack([low2, high2], 1).tolist()
    )
    axis.imshow(
        np.log1p(counts).T, origin="lower", cmap="Greys", alpha=0.7,
        vmax=float(np.log1p(counts).max() or 1), interpolation="bilinear", zorder=1,
        extent=(low2[0], high2[0], low2[1], high2[1]),
    )  # fmt: skip


def _draw_estimates(
    axis: Any, frames: Sequence[DriveFrame], plan: Array, tick_length: float
) -> None:
    accepted = [f.T_map_cam for f in frames if f.T_map_cam is not None]
    if accepted:
        at = np.array([T[:3, 3] for T in accepted]) @ plan.T
        looking = np.array([T[:3, 2] for T in accepted]) @ plan.T
        ticks = [[a, a + tick_length * v] for a, v in zip(at, looking, strict=True)]
        axis.add_collection(LineCollection(ticks, colors=BLUE, linewidths=0.9, zorder=4))
        axis.plot(
            *at.T, ".", color=BLUE, markersize=6, zorder=5,
            label=f"localized ({len(at)}), tick: viewing direction",
        )  # fmt: skip
    lost = [f.T_map_cam_true for f in frames if f.T_map_cam is None]
    known = np.array([T[:3, 3] for T in lost if T is not None]).reshape(-1, 3) @ plan.T
    if len(known):
        axis.plot(*known.T, "x", color=RED, markersize=7, zorder=5, label=f"lost ({len(known)})")


def _draw_ellipses(
    axis: Any, frames: Sequence[DriveFrame], plan: Array, size: float
) -> None:
    """95 % ellipses of some positions, enlarged until they can be seen."""
    known = [f for f in frames if f.T_map_cam is not None and f.covariance is not None]
    if not known:
        return
    widths, centres, angles = [], [], []
    for frame in known[:: max(1, len(known) // _ELLIPSES)]:
        assert frame.T_map_cam is not None and frame.covariance is not None
        values, axes = np.linalg.eigh(plan @ frame.covariance[:3, :3] @ plan.T)
        widths.append(2 * np.sqrt(_CHI2_95 * np.maximum(values, 0)))
        angles.append(np.degrees(np.arctan2(axes[1, 0], axes[0, 0])))
        centres.append(plan @ frame.T_map_cam[:3, 3])
    wanted = _ELLIPSE_SHARE * size / max(float(np.median(widths)), 1e-12)
    times = max(1, int(float(f"{wanted:.0e}")))  # one digit
    large = times * np.array(widths)
    axis.add_collection(EllipseCollection(
        large[:, 0], large[:, 1], angles, units="xy", offsets=centres, zorder=6,
        offset_transform=axis.transData, facecolors="none", edgecolors=ORANGE, linewidths=1.2,
    ))  # fmt: skip
    axis.plot([], [], "o", markerfacecolor="none", markeredgecolor=ORANGE,
              label=f"95 % ellipses, {times} times as large")  # fmt: skip


def _error_figure(drive: Drive) -> Figure:
    figure, axes = new_figure(8.4, 4.6, rows=2)
    accepted = [f for f in drive.frames if f.T_map_cam is not None]
    time = [f.time_s for f in accepted]
    errors = np.array([f.error for f in accepted]).reshape(-1, 2)
    rows = (
        ("position error [cm]", errors[:, 1] * 100, "error_m", 100.0),
        ("rotation error [deg]", errors[:, 0], "error_deg", 1.0),
    )
    for axis, (label, values, name, factor) in zip(axes, rows, strict=True):
        axis.plot(time, values, ".-", color=BLUE, linewidth=1, markersize=5)
        median = drive.figures.get(f"median_{name}", math.nan) * factor
        if math.isfinite(median):
            axis.axhline(median, color=BLUE, linestyle=":", linewidth=1.2)
            text = f" median {median:.2g}"
            axis.annotate(text, (1, median), xycoords=("axes fraction", "data"), color=BLUE)
        limit = drive.limits.get(f"max_{name}", math.nan) * factor
        if math.isfinite(limit) and len(values) and np.nanmax(values) > 0.3 * limit:
            axis.axhline(limit, color=RED, linestyle="--", linewidth=1.2)
        axis.set_ylabel(label)
        axis.set_ylim(bottom=0)
        for frame in drive.frames:
            if frame.T_map_cam is None:
                axis.axvline(frame.time_s, color=RED, linewidth=1, alpha=0.5)
    lost = any(frame.T_map_cam is None for frame in drive.frames)
    axes[-1].set_xlabel("time in the recording [s]" + ("; red lines: lost" if lost else ""))
    return figure


def _latency_figure(drive: Drive) -> Figure:
    figure, axes = new_figure(8.4, 4.6, rows=2)
    accepted = [f for f in drive.frames if f.T_map_cam is not None]
    time = np.array([f.time_s for f in accepted])
    stages = sorted({s for f in accepted for s in f.timings_ms if s != "total"})
    stages.sort(key=lambda s: -np.mean([f.timings_ms.get(s, 0.0) for f in accepted]))
    if accepted and stages:
        values = np.array([[f.timings_ms.get(s, 0.0) for f in accepted] for s in stages])
        colours = matplotlib.colormaps["Blues"](np.linspace(0.75, 0.2, len(stages)))
        axes[0].stackplot(time, values, labels=stages, colors=colours, linewidth=0)
    axes[0].plot(
        time, [f.latency_ms for f in accepted], ".-", color="black", linewidth=1, markersize=4,
        label="image stamp to pose received",
    )  # fmt: skip
    axes[0].set(ylabel="latency [ms]", ylim=(0, None))
    if accepted:
        figure.legend(loc="outside upper center", fontsize=8, ncols=6, frameon=False)
    axes[1].plot(
        [m.time_s for m in drive.memory], [m.rss_mb for m in drive.memory], color=BLUE
    )
    highest = max((m.rss_mb for m in drive.memory), default=1.0)
    axes[1].set(
        ylabel="memory [MB]", ylim=(0, 1.15 * highest), xlabel="time since the drive began [s]"
    )
    return figure


# --- the page ---

# name, label, unit, factor, digits
_CARDS = (
    ("accepted_ratio", "frames with an accepted pose", "%", 100.0, 1),
    ("median_error_m", "median position error", "cm", 100.0, 2),
    ("median_error_deg", "median rotation error", "°", 1.0, 3),
    ("max_error_m", "largest position error", "cm", 100.0, 2),
    ("max_error_deg", "largest rotation error", "°", 1.0, 2),
    ("rate_hz", "poses a second", "Hz", 1.0, 2),
    ("latency_ms_p95", "latency, 95th percentile", "ms", 1.0, 0),
    ("rss_mb", "memory of the localizer", "MB", 1.0, 0),
)


def _page(drive: Drive, plots: Mapping[str, bytes]) -> str:
    failed = {line.split(" ")[0] for line in missed(drive.figures, drive.limits)}
    lead = (
        f"{int(drive.figures['accepted'])} of {int(drive.figures['processed'])} "
        f"processed frames localized, {int(drive.figures['sent'])} images played."
    )
    parts = [
        cards(drive.figures, _CARDS, failed),
        "<h2>Trajectory</h2>",
        plot(plots["trajectory"], "Grey: the map's Gaussians around camera height."),
        "<h2>Error over time</h2>",
        plot(plots["errors"], "Against the recording's true poses."),
        "<h2>Latency and memory</h2>",
        plot(plots["latency"], "Stages as the localizer measured them, stacked."),
        "<h2>What the camera saw, and what the map shows from the pose found</h2>",
        *[_overlay(overlay) for overlay in drive.overlays],
        "<h2>All figures</h2>",
        facts_table({k: number(v) for k, v in drive.figures.items()}, failed),
        "<h2>What was run</h2>",
        facts_table(drive.facts),
    ]
    return page(drive.title, lead, parts)


def _overlay(overlay: Overlay) -> str:
    frame = overlay.frame
    angle_deg, distance_m = frame.error
    error = f", error {distance_m * 100:.2f} cm and {angle_deg:.3f}°" if distance_m >= 0 else ""
    caption = f"t = {frame.time_s:.1f} s: {frame.inliers} inliers{error}"
    return pictures(overlay.labelled(), caption)
