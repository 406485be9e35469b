"""The report of a drive: plots as PNG, and one HTML page that needs no other file."""

from __future__ import annotations

import base64
import html
import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from igaussian_core.evaluate.drive import DriveFrame, MemorySample, Trajectory
from igaussian_core.evaluate.drive_overlays import Overlay

Array = NDArray[np.float64]

_TRUTH, _ESTIMATE, _LOST, _GRID = "#8a939e", "#0b6fa4", "#c8322b", "#e4e8ec"
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
    pictures = {
        "trajectory": _png(_trajectory_figure(drive)),
        "errors": _png(_error_figure(drive)),
        "latency": _png(_latency_figure(drive)),
    }
    for name, data in pictures.items():
        (folder / f"{name}.png").write_bytes(data)
    for old in folder.glob("overlay_*.png"):
        old.unlink()
    for index, overlay in enumerate(drive.overlays):
        path = folder / f"overlay_{index}.png"
        cv2.imwrite(str(path), overlay.side_by_side()[..., ::-1])
    (folder / "summary.json").write_text(json.dumps(plain(drive.figures), indent=1) + "\n")
    page = folder / "report.html"
    page.write_text(_page(drive, pictures), encoding="utf-8")
    return page


def plain(figures: Mapping[str, float]) -> dict[str, float | int | None]:
    """Figures as JSON values: whole numbers as integers, NaN as null."""
    result: dict[str, float | int | None] = {}
    for name, value in figures.items():
        if not math.isfinite(value):
            result[name] = None
        else:
            result[name] = int(value) if value == int(value) else round(value, 6)
    return result


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


def _figure(width: float, height: float, rows: int = 1) -> tuple[Figure, Any]:
    figure = Figure(figsize=(width, height), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0]
    for axis in axes:
        axis.grid(color=_GRID, linewidth=0.8)
        axis.set_axisbelow(True)
        for side in ("top", "right"):
            axis.spines[side].set_visible(False)
    return figure, axes


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()


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
    figure, (axis,) = _figure(8.4, 6.4)
    if not poses:
        axis.text(0.5, 0.5, "no pose", ha="center", transform=axis.transAxes)
        return figure
    right, ahead, up, names = plan_axes(poses)
    plan = np.stack([right, ahead])
    path = np.array([T[:3, 3] for T in poses])
    _draw_map(axis, drive.map_points, plan, up, path)
    true = path @ plan.T
    if len(drive.truth):
        axis.plot(*true.T, color=_TRUTH, linewidth=5, alpha=0.7, label="truth", zorder=3)
    _draw_estimates(axis, drive.frames, plan, 0.05 * float(np.ptp(true, axis=0).max()))
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
        axis.add_collection(LineCollection(ticks, colors=_ESTIMATE, linewidths=0.9, zorder=4))
        axis.plot(
            *at.T, ".", color=_ESTIMATE, markersize=6, zorder=5,
            label=f"localized ({len(at)}), tick: viewing direction",
        )  # fmt: skip
    lost = [f.T_map_cam_true for f in frames if f.T_map_cam is None]
    known = np.array([T[:3, 3] for T in lost if T is not None]).reshape(-1, 3) @ plan.T
    if len(known):
        axis.plot(*known.T, "x", color=_LOST, markersize=7, zorder=5, label=f"lost ({len(known)})")


def _error_figure(drive: Drive) -> Figure:
    figure, axes = _figure(8.4, 4.6, rows=2)
    accepted = [f for f in drive.frames if f.T_map_cam is not None]
    time = [f.time_s for f in accepted]
    errors = np.array([f.error for f in accepted]).reshape(-1, 2)
    rows = (
        ("position error [cm]", errors[:, 1] * 100, "error_m", 100.0),
        ("rotation error [deg]", errors[:, 0], "error_deg", 1.0),
    )
    for axis, (label, values, name, factor) in zip(axes, rows, strict=True):
        axis.plot(time, values, ".-", color=_ESTIMATE, linewidth=1, markersize=5)
        median = drive.figures.get(f"median_{name}", math.nan) * factor
        if math.isfinite(median):
            axis.axhline(median, color=_ESTIMATE, linestyle=":", linewidth=1.2)
            text = f" median {median:.2g}"
            axis.annotate(text, (1, median), xycoords=("axes fraction", "data"), color=_ESTIMATE)
        limit = drive.limits.get(f"max_{name}", math.nan) * factor
        if math.isfinite(limit) and len(values) and np.nanmax(values) > 0.3 * limit:
            axis.axhline(limit, color=_LOST, linestyle="--", linewidth=1.2)
        axis.set_ylabel(label)
        axis.set_ylim(bottom=0)
        for frame in drive.frames:
            if frame.T_map_cam is None:
                axis.axvline(frame.time_s, color=_LOST, linewidth=1, alpha=0.5)
    lost = any(frame.T_map_cam is None for frame in drive.frames)
    axes[-1].set_xlabel("time in the recording [s]" + ("; red lines: lost" if lost else ""))
    return figure


def _latency_figure(drive: Drive) -> Figure:
    figure, axes = _figure(8.4, 4.6, rows=2)
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
        figure.legend(loc="outside upper center", fontsize=8, ncols=8, frameon=False)
    axes[1].plot(
        [m.time_s for m in drive.memory], [m.rss_mb for m in drive.memory], color=_ESTIMATE
    )
    highest = max((m.rss_mb for m in drive.memory), default=1.0)
    axes[1].set(
        ylabel="memory [MB]", ylim=(0, 1.15 * highest), xlabel="time since the drive began [s]"
    )
    return figure


# --- the page ---

_STYLE = """
body{font:16px/1.5 system-ui,sans-serif;color:#1c2530;margin:0;background:#f4f6f8}
main{max-width:1080px;margin:0 auto;padding:24px}
h1{font-size:26px;margin:0 0 4px}h2{font-size:19px;margin:32px 0 8px}
p.lead{margin:0 0 20px;color:#55606c}
.cards{display:grid;grid-template-columns:repeat(auto-fit,minmax(220px,1fr));gap:12px}
.card{background:#fff;border:1px solid #e0e5ea;border-radius:8px;padding:12px 14px}
.card b{display:block;font-size:24px;line-height:1.25;font-variant-numeric:tabular-nums}
.card span{font-size:13px;color:#55606c}.card.bad{border-color:#c8322b;background:#fdf1f0}
img{max-width:100%;height:auto;display:block;margin:0 auto;background:#fff;border-radius:8px}
figure{margin:0 0 20px;background:#fff;border:1px solid #e0e5ea;border-radius:8px;padding:10px}
figcaption{font-size:13px;color:#55606c;margin-top:6px;font-variant-numeric:tabular-nums}
.pair{display:grid;grid-template-columns:1fr 1fr 1fr;gap:6px}
.pair span{font-size:12px;color:#55606c}
table{border-collapse:collapse;background:#fff;font-size:14px;font-variant-numeric:tabular-nums}
td,th{padding:4px 14px 4px 8px;border-bottom:1px solid #e9edf1;text-align:left}
.bad td{color:#c8322b}
"""

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


def _page(drive: Drive, pictures: Mapping[str, bytes]) -> str:
    failed = {line.split(" ")[0] for line in missed(drive.figures, drive.limits)}
    parts = [
        "<!doctype html><html lang=en><meta charset=utf-8>",
        "<meta name=viewport content='width=device-width,initial-scale=1'>",
        f"<title>{html.escape(drive.title)}</title><style>{_STYLE}</style><main>",
        f"<h1>{html.escape(drive.title)}</h1>",
        f"<p class=lead>{int(drive.figures['accepted'])} of {int(drive.figures['processed'])} "
        f"processed frames localized, {int(drive.figures['sent'])} images played.</p>",
        _cards(drive.figures, failed),
        "<h2>Trajectory</h2>",
        _picture(pictures["trajectory"], "Grey: the map's Gaussians around camera height."),
        "<h2>Error over time</h2>",
        _picture(pictures["errors"], "Against the recording's true poses."),
        "<h2>Latency and memory</h2>",
        _picture(pictures["latency"], "Stages as the localizer measured them, stacked."),
        "<h2>What the camera saw, and what the map shows from the pose found</h2>",
        *[_overlay(overlay) for overlay in drive.overlays],
        "<h2>All figures</h2>",
        _table({k: _number(v) for k, v in drive.figures.items()}, failed),
        "<h2>What was run</h2>",
        _table(drive.facts, set()),
        "</main></html>",
    ]
    return "\n".join(parts)


def _cards(figures: Mapping[str, float], failed: set[str]) -> str:
    cards = []
    for name, label, unit, factor, digits in _CARDS:
        value = figures.get(name, math.nan) * factor
        text = f"{value:.{digits}f}&nbsp;{unit}" if math.isfinite(value) else "–"
        kind = "card bad" if name in failed else "card"
        cards.append(f"<div class='{kind}'><b>{text}</b><span>{label}</span></div>")
    return f"<div class=cards>{''.join(cards)}</div>"


def _overlay(overlay: Overlay) -> str:
    frame = overlay.frame
    angle_deg, distance_m = frame.error
    error = f", error {distance_m * 100:.2f} cm and {angle_deg:.3f}°" if distance_m >= 0 else ""
    caption = f"t = {frame.time_s:.1f} s: {frame.inliers} inliers{error}"
    images = (
        ("camera", overlay.live), ("map at the pose found", overlay.render),
        ("both in alternate tiles", overlay.checkered()),
    )  # fmt: skip
    cells = []
    for label, image in images:
        _, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 82])
        source = _data_url(data.tobytes(), "jpeg")
        cells.append(f"<div><img src='{source}' alt='{label}'><span>{label}</span></div>")
    return _framed(f"<div class=pair>{''.join(cells)}</div>", caption)


def _picture(data: bytes, caption: str) -> str:
    return _framed(f"<img src='{_data_url(data, 'png')}' alt=''>", caption)


def _framed(content: str, caption: str) -> str:
    return f"<figure>{content}<figcaption>{caption}</figcaption></figure>"


def _data_url(data: bytes, kind: str) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"


def _table(rows: Mapping[str, str], failed: set[str]) -> str:
    lines = []
    for name, value in rows.items():
        kind = " class=bad" if name in failed else ""
        lines.append(f"<tr{kind}><td>{html.escape(name)}</td><td>{html.escape(value)}</td></tr>")
    return f"<table>{''.join(lines)}</table>"


def _number(value: float) -> str:
    if not math.isfinite(value):
        return "–"
    return str(int(value)) if value == int(value) else f"{value:.4g}"
