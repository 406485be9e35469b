"""What an evaluation leaves: JSON, CSV, and one HTML page with plots and cases."""

from __future__ import annotations

import csv
import dataclasses
import json
import math
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from igaussian_core import __version__
from igaussian_core.config import Config
from igaussian_core.errors import ConfigError
from igaussian_core.evaluate.metrics import (
    NEES_95,
    QueryOutcome,
    by_group,
    plain,
    recall_curve,
    stage_times,
    summarize,
    to_json,
)
from igaussian_core.evaluate.overlays import make_pair
from igaussian_core.evaluate.page import (
    BLUE,
    GREY,
    RED,
    cards,
    facts_table,
    new_figure,
    number,
    page,
    pictures,
    plot,
    png,
    table,
)
from igaussian_core.evaluate.runner import Queries
from igaussian_core.geometry import quaternion_from_rotation
from igaussian_core.localizer import Localizer

_COLOURS = (BLUE, "#d98b19", "#5b8c3a", "#8c4fa3", RED)
_MEASURED_WITH = ("torch", "numpy", "opencv-python-headless", "kornia", "poselib")


@dataclass(frozen=True)
class Evaluation:
    """One track's outcome on one map.

    Attributes:
        title: of the report.
        track: "rendered" or "photos"; never mixed.
        max_deg, max_distance: success is within both; the distance in map units.
        facts: what was run, by name, for the reader.
    """

    title: str
    track: str
    outcomes: Sequence[QueryOutcome]
    max_deg: float
    max_distance: float
    memory_mb: float
    config: Config
    facts: Mapping[str, str]

    def summary(self) -> dict[str, float]:
        """The figures of all queries."""
        figures = summarize(self.outcomes, self.max_deg, self.max_distance)
        return {**figures, "memory_mb": self.memory_mb}

    def groups(self) -> dict[str, dict[str, float]]:
        """The figures by group, where there are several."""
        parts = by_group(self.outcomes)
        if len(parts) < 2:
            return {}
        return {k: summarize(v, self.max_deg, self.max_distance) for k, v in parts.items()}

    def limit_text(self) -> str:
        if math.isinf(self.max_distance):
            return f"within {self.max_deg:g}°, wherever"
        return f"within {self.max_deg:g}° and {self.max_distance:.3g} map units"


def machine_facts() -> dict[str, str]:
    """The machine and the versions that figures were measured with."""
    facts = {
        "date": datetime.now(timezone.utc).strftime("%Y-%m-%d"),
        "machine": f"{_processor()}, {_cores()} cores",
        "load": f"{os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "unknown",
        "Python": platform.python_version(),
        "igaussian": __version__,
    }
    for name in _MEASURED_WITH:
        try:
            facts[name] = version(name)
        except PackageNotFoundError:
            facts[name] = "not installed"
    return facts


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    except OSError:
        names = []
    return names[0] if names else platform.machine()


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


# --- files ---


def write_json(evaluation: Evaluation, path: Path) -> None:
    """Everything, one query a line.

    Raises:
        ConfigError: the file cannot be written.
    """
    head = {
        "track": evaluation.track,
        "title": evaluation.title,
        "facts": dict(evaluation.facts),
        "thresholds": plain({"deg": evaluation.max_deg, "distance": evaluation.max_distance}),
        "summary": plain(evaluation.summary()),
        "groups": {k: plain(v) for k, v in evaluation.groups().items()},
        "stage_times": {k: plain(v) for k, v in stage_times(evaluation.outcomes).items()},
        "config": dataclasses.asdict(evaluation.config),
    }
    queries = ",\n".join(json.dumps(to_json(o)) for o in evaluation.outcomes)
    text = json.dumps(head, indent=1)[:-2] + f',\n "queries": [\n{queries}\n ]\n}}\n'
    write_text(path, text)


def write_csv(evaluation: Evaluation, path: Path) -> None:
    """One line a query; empty where there is no value. Poses are T_map_cam.

    Raises:
        ConfigError: the file cannot be written.
    """
    stages = list(stage_times(evaluation.outcomes))
    columns = [
        "name", "group", "status", "source", "inliers", "inlier_ratio", "angle_deg", "distance",
        "coarse_angle_deg", "coarse_distance", "nees",
    ]  # fmt: skip
    try:
        with open(path, "w", newline="", encoding="utf-8") as stream:
            writer = csv.writer(stream)
            writer.writerow([*columns, "tx", "ty", "tz", "qw", "qx", "qy", "qz",
                             *(f"{stage}_ms" for stage in stages)])  # fmt: skip
            for o in evaluation.outcomes:
                data = to_json(o)
                row: list[Any] = [data[name] for name in columns]
                if o.T_map_cam is None:
                    row += [None] * 7
                else:
                    row += [*o.T_map_cam[:3, 3], *quaternion_from_rotation(o.T_map_cam[:3, :3])]
                writer.writerow(row + [data["timings_ms"].get(stage) for stage in stages])
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error}") from error


def write_text(path: Path, text: str) -> None:
    """Write a whole file.

    Raises:
        ConfigError: it cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error}") from error


# --- the page ---

_CARDS = (
    ("success", "success", "%", 100.0, 1),
    ("median_deg", "median rotation error", "°", 1.0, 3),
    ("median_distance", "median position error", "map units", 1.0, 4),
    ("auc", "area under the recall curve", "%", 100.0, 1),
    ("wrong_accepted", "accepted and wrong", "", 1.0, 0),
    ("median_ms", "a frame, median", "ms", 1.0, 0),
    ("mean_nees", "mean NEES (6 wanted)", "", 1.0, 1),
    ("memory_mb", "memory, at most", "MB", 1.0, 0),
)
_GROUP_COLUMNS = (
    ("queries", "queries", 1.0), ("success", "success %", 100.0),
    ("wrong_accepted", "accepted, wrong", 1.0), ("mean_deg", "mean °", 1.0),
    ("median_deg", "median °", 1.0), ("within_15_deg", "≤ 15° %", 100.0),
    ("mean_distance", "mean distance", 1.0), ("median_distance", "median distance", 1.0),
    ("within_half_unit", "≤ 0.5 %", 100.0), ("median_ms", "median ms", 1.0),
)  # fmt: skip


def write_html(
    evaluation: Evaluation, queries: Queries, localizer: Localizer, path: Path
) -> None:
    """The report: figures, plots, and cases as pictures of image and render.

    Raises:
        ConfigError: the file cannot be written.
    """
    summary = evaluation.summary()
    accepted, total = int(summary["accepted"]), int(summary["queries"])
    lead = (
        f"{total} queries of the {evaluation.track} track, {accepted} accepted; success is a "
        f"pose {evaluation.limit_text()}. Queries without a pose count as infinitely wrong."
    )
    parts = [cards(summary, _CARDS, {"wrong_accepted"} if summary["wrong_accepted"] else set())]
    groups = evaluation.groups()
    if groups:
        head = ["group", *(label for _, label, _ in _GROUP_COLUMNS)]
        rows = [
            [name, *(number(s[key] * factor) for key, _, factor in _GROUP_COLUMNS)]
            for name, s in groups.items()
        ]
        parts += ["<h2>By group</h2>", table(head, rows)]
    parts += [
        "<h2>Recall</h2>",
        plot(png(_recall_figure(evaluation)), "Share of queries with an error up to a threshold."),
        "<h2>Errors</h2>",
        plot(png(_error_figure(evaluation)), "Accepted poses; dashed: the limits of success."),
        "<h2>Time by stage</h2>",
        plot(png(_time_figure(evaluation)),
             "Median over the queries that went through a stage; line: 95th percentile."),
        "<h2>Covariance</h2>",
        plot(png(_nees_figure(evaluation)),
             f"{summary['inside_95']:.1%} inside the 95 % ellipsoid; line: what a true covariance "
             "gives."),
    ]  # fmt: skip
    for heading, chosen in _cases(evaluation):
        if chosen:
            parts.append(f"<h2>{heading}</h2>")
            parts += [_case(o, queries, localizer) for o in chosen]
    figures = {name: number(value) for name, value in summary.items()}
    parts += ["<h2>All figures</h2>", facts_table(figures)]
    parts += ["<h2>What was run</h2>", facts_table(evaluation.facts)]
    settings = {name: str(value) for name, value in evaluation.config.to_flat().items()}
    parts += ["<h2>Configuration</h2>", facts_table(settings)]
    write_text(path, page(evaluation.title, lead, parts))


def _cases(evaluation: Evaluation) -> list[tuple[str, list[QueryOutcome]]]:
    """Headings with the outcomes to show under them."""

    def size(o: QueryOutcome) -> float:
        return max(o.angle_deg / evaluation.max_deg, o.distance / evaluation.max_distance)

    accepted = sorted((o for o in evaluation.outcomes if o.accepted), key=size)
    lost = sorted(
        (o for o in evaluation.outcomes if not o.accepted), key=lambda o: -o.inliers
    )
    worst = list(reversed(accepted[-4:]))
    middle = accepted[len(accepted) // 2 :][:2] if len(accepted) > 8 else []
    best = accepted[:2] if len(accepted) > 6 else []
    return [
        ("Worst accepted poses", worst), ("Rejected: the best hypothesis of each", lost[:6]),
        ("Median cases", middle), ("Best cases", best),
    ]  # fmt: skip


def _case(o: QueryOutcome, queries: Queries, localizer: Localizer) -> str:
    index = next(i for i in range(len(queries)) if queries.name(i) == o.name)
    image, camera = queries.image(index)
    T_map_cam = o.T_map_cam if o.T_map_cam is not None else o.T_map_cam_coarse
    if o.accepted:
        text = f"{o.name}: {o.angle_deg:.3f}°, {o.distance:.4f}; {o.inliers} inliers, {o.status}"
    else:
        text = f"{o.name}: {o.status}, {o.reason}"
        if T_map_cam is not None:
            text += f"; the hypothesis is {o.coarse_angle_deg:.2f}°, {o.coarse_distance:.3f} off"
    if T_map_cam is None:
        return pictures([("camera", image)], text)
    return pictures(make_pair(localizer, image, camera, T_map_cam, 480).labelled(), text)


def _recall_figure(evaluation: Evaluation) -> Figure:
    figure, axes = new_figure(9.4, 3.4, columns=2)
    for colour, (name, part) in zip(
        _COLOURS * 9, by_group(evaluation.outcomes).items(), strict=False
    ):
        limits = (evaluation.max_deg, evaluation.max_distance)
        for axis, key, limit in zip(axes, ("angle_deg", "distance"), limits, strict=True):
            errors = np.array([getattr(o, key) for o in part])
            known = errors[np.isfinite(errors)]
            low = max(1e-6, float(np.min(known, initial=limit)) / 2)
            reach = 4 * limit if math.isfinite(limit) else float(np.max(known, initial=1e-9))
            x, y = recall_curve(errors, reach)
            label = f"{name}°" if name else None
            axis.step(np.maximum(x, low), 100 * y, where="post", color=colour, label=label)
            if math.isfinite(limit):
                axis.axvline(limit, color=GREY, linestyle="--", linewidth=1)
    for axis, text in zip(axes, ("rotation error [deg]", "position error [map units]"),
                          strict=True):  # fmt: skip
        axis.set(xscale="log", ylim=(0, 102), xlabel=text)
    axes[0].set_ylabel("recall [%]")
    if len(by_group(evaluation.outcomes)) > 1:
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=5,
                      frameon=False)  # fmt: skip
    return figure


def _error_figure(evaluation: Evaluation) -> Figure:
    figure, axes = new_figure(9.4, 3.4, columns=2)
    limits = (evaluation.max_deg, evaluation.max_distance)
    labels = ("rotation error [deg]", "position error [map units]")
    for axis, key, limit, label in zip(
        axes, ("angle_deg", "distance"), limits, labels, strict=True
    ):
        errors = np.array([getattr(o, key) for o in evaluation.outcomes])
        errors = np.maximum(errors[np.isfinite(errors)], 1e-9)
        if len(errors):
            highest = float(errors.max()) * 1.1
            highest = max(highest, 1.2 * limit) if math.isfinite(limit) else highest
            edges = np.geomspace(errors.min() * 0.9, highest, 30)
            axis.hist(errors, edges, color=BLUE)
            axis.axvline(float(np.median(errors)), color="black", linewidth=1)
        if math.isfinite(limit):
            axis.axvline(limit, color=RED, linestyle="--", linewidth=1.2)
        axis.set(xscale="log", xlabel=label)
    axes[0].set_ylabel("queries")
    return figure


def _time_figure(evaluation: Evaluation) -> Figure:
    times = stage_times(evaluation.outcomes)
    figure, (axis,) = new_figure(9.4, 0.8 + 0.32 * max(len(times), 1))
    names = list(times)[::-1]
    medians = [times[name]["median_ms"] for name in names]
    tails = [times[name]["p95_ms"] for name in names]
    shades = matplotlib.colormaps["Blues"](0.7)
    axis.barh(names, medians, color=[GREY if name == "total" else shades for name in names])
    axis.hlines(names, medians, tails, color="black", linewidth=1)
    for name, median in zip(names, medians, strict=True):
        axis.annotate(f" {median:.0f}", (0, name), va="center", fontsize=8)
    axis.set_xlabel("ms")
    axis.grid(visible=False, axis="y")
    return figure


def _nees_figure(evaluation: Evaluation) -> Figure:
    figure, (axis,) = new_figure(9.4, 3.0)
    nees = np.array([o.nees for o in evaluation.outcomes if np.isfinite(o.nees)])
    edges = np.linspace(0, 30, 31)
    if len(nees):
        axis.hist(np.minimum(nees, 29.9), edges, color=BLUE, label="30 and more: last bar")
        x = np.linspace(0, 30, 300)
        density = x**2 * np.exp(-x / 2) / 16  # chi squared, 6 degrees of freedom
        axis.plot(x, len(nees) * (edges[1] - edges[0]) * density, color="black", linewidth=1)
        axis.legend(frameon=False)
    axis.axvline(NEES_95, color=RED, linestyle="--", linewidth=1.2)
    axis.set(xlabel="NEES", ylabel="queries")
    return figure
