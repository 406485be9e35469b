"""Markdown of the figures in benchmarks/results: what docs/benchmarks.md is made of."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

Row = dict[str, Any]


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table, or a line where it has no rows."""
    if not rows:
        return "No figures."
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])


def peers_markdown(name: str, rows: Sequence[Row]) -> str:
    """A table of benchmarks/peers.py in the layout that fits it."""
    if name == "rotation":
        keys = ("mean_deg", "median_deg", "within_15_deg")
        return _by_bin(rows, keys, ("avg °", "med °", "≤ 15°"))
    if name == "rendered":
        first = _by_bin(rows, ("success", "median_ms"), ("success", "ms"))
        keys = ("mean_distance", "median_distance", "within_half_unit", "mean_deg", "median_deg",
                "within_15_deg")  # fmt: skip
        labels = ("avg m", "med m", "≤ 0.5 m", "avg °", "med °", "≤ 15°")
        return first + "\n\nLayout of table 3:\n\n" + _by_bin(rows, keys, labels)
    return _overall(rows)


def _by_bin(rows: Sequence[Row], keys: Sequence[str], labels: Sequence[str]) -> str:
    bins = next((list(row["groups"]) for row in rows if "groups" in row), [])
    head = ["scene", "method", "queries", *(f"{label}, {b}°" for b in bins for label in labels)]
    lines = []
    for row in rows:
        cells = [value(row["groups"][b], key) for b in bins for key in keys]
        lines.append([row["case"], row["method"], _count(row), *cells])
    return markdown(head, lines)


_OVERALL = (
    ("success", "success"), ("wrong_accepted", "accepted, wrong"), ("mean_deg", "avg °"),
    ("median_deg", "med °"), ("mean_distance", "avg distance"),
    ("median_distance", "med distance"), ("auc", "AUC"), ("median_ms", "ms"),
)  # fmt: skip


def _overall(rows: Sequence[Row]) -> str:
    head = ["scene", "method", "queries", *(label for _, label in _OVERALL)]
    lines = []
    for row in rows:
        cells = [value(row["summary"], key) for key, _ in _OVERALL]
        lines.append([row["case"], row["method"], _count(row), *cells])
    return markdown(head, lines)


def _count(row: Row) -> str:
    steps = f", {row['iterations']} steps" if "iterations" in row else ""
    return f"{row['summary']['queries']}{steps}"


def value(figures: Row, key: str) -> str:
    """One figure: shares in per cent, times in whole milliseconds, a dash for none."""
    number = figures.get(key)
    if number is None:
        return "–"
    if key in ("success", "within_15_deg", "within_half_unit", "inside_95") or "auc" in key:
        return f"{100 * number:.1f} %"
    if key in ("wrong_accepted", "queries", "accepted"):
        return str(int(number))
    if key.endswith("ms"):
        return f"{number:.0f}"
    if key.endswith("nees"):
        return f"{number:.1f}"
    if number >= 1e4:
        return f"{number:.1e}"
    return f"{number:.3f}" if key.endswith("deg") else f"{number:.4f}"


# --- sections of docs/benchmarks.md ---


def _facts(data: Row) -> str:
    return "; ".join(f"{k}: {v}" for k, v in data.get("facts", {}).items())


_PEER_TABLES = {
    "rendered": "Rendered track (tables 1 and 3 of the paper)",
    "rotation": "Pure rotation (table 2)",
    "photos": "Photos that the map was not trained on",
    "ablation": "Ablation (table 4)",
    "views": "Number of source views (figure 5)",
}


def peers(data: Row) -> str:
    """benchmarks/peers.py."""
    parts = [
        "## Other methods on the same queries",
        f"`python benchmarks/peers.py --json out.json`. {_facts(data)}",
        "Every method gets the same images, the same reference views (renders of the map on the "
        "rendered track, training photos on the photo track) and the same map. Gradient descent "
        "from the prior starts at the protocol's source pose (rendered) or 10 degrees and 5 % of "
        "the extent away (photos). `benchmarks/peer_methods.py` describes each. Photos succeed "
        "within 5 degrees and 5 % of the cameras' extent, rendered targets within 5 degrees and "
        "0.05. Methods with a network trained on the map are shown where one was trained.",
    ]
    for name, title in _PEER_TABLES.items():
        if name in data:
            parts += [f"### {title}", peers_markdown(name, data[name])]
    return "\n\n".join(parts)


def evaluation(title: str, command: str) -> Callable[[Row], str]:
    """A section of one output of `igaussian eval`."""

    def section(data: Row) -> str:
        groups = {"all": data["summary"], **data["groups"]}
        keys = [key for key in data["summary"] if key != "memory_mb"]
        rows = [[key, *(value(s, key) for s in groups.values())] for key in keys]
        stages = [[stage, *(f"{ms:.1f}" for ms in (t["median_ms"], t["p95_ms"]))]
                  for stage, t in data["stage_times"].items()]  # fmt: skip
        limits = data["thresholds"]
        where = "" if limits["distance"] is None else f" and {limits['distance']:.3g} map units"
        return "\n\n".join([
            f"## {title}", f"`{command}`. {_facts(data)}",
            f"Success: within {limits['deg']:g} degrees{where}.",
            markdown(["figure", *groups], rows),
            markdown(["stage", "median ms", "95 % ms"], stages),
        ])  # fmt: skip

    return section


def drive(data: Row) -> str:
    """One output of `igaussian eval bag`."""
    return "\n\n".join([
        "## Tracking: every frame of the bundled drive",
        "`igaussian eval bag bags/demo/drive --map room.igmap --every-frame --duration 12 "
        f"--json out.json`. {_facts(data)}",
        markdown(["figure", "value"],
                 [[key, f"{number:.4g}"] for key, number in data["summary"].items()]),
    ])  # fmt: skip


def photos(data: Row) -> str:
    """benchmarks/photos.py."""
    keys = ("success", "wrong_accepted", "median_deg", "median_distance", "p90_deg",
            "p90_distance", "coarse_median_deg", "coarse_median_distance", "mean_nees",
            "median_ms")  # fmt: skip
    rows = [[row["case"], value(row["summary"], "queries"),
             *(value(row["summary"], key) for key in keys)] for row in data["photos"]]  # fmt: skip
    crossed = [[row["map"], str(row["photos"]), str(row["accepted"]), str(row["inliers"])]
               for row in data["cross_scene"]]  # fmt: skip
    return "\n\n".join([
        "## Real photos, from nothing", f"`python benchmarks/photos.py --json out.json`. "
        f"{_facts(data)}", markdown(["set", "queries", *keys], rows),
        "Photos of other scenes, all of which must be refused:",
        markdown(["map", "photos", "accepted", "most inliers"], crossed),
    ])  # fmt: skip


def verdict(data: Row) -> str:
    """benchmarks/verdict.py."""
    kinds = data["images"]
    keys = ("images", "accepted", "right", "wrong_accepted", "wrong_inliers")
    rows = [
        [kind, *(str(row[key]) for key in keys), f"{row['wrong_confidence']:.2f}"]
        for kind, row in kinds.items()
    ]
    usable = [row for row in kinds.values() if row["usable"]]
    right, all_usable = (sum(row[key] for row in usable) for key in ("right", "images"))
    wrong, images = (sum(r[key] for r in kinds.values()) for key in ("wrong_accepted", "images"))
    return "\n\n".join([
        "## What must be refused, and what must not",
        f"`python benchmarks/verdict.py --photos 3 --json out.json --roc docs/verdict_roc.png`. "
        f"{_facts(data)}",
        "Against five maps, from nothing; photos of other scenes also with a prior. Right: within "
        "5 degrees and 5 % of the cameras' extent.",
        markdown(["image", "images", "accepted", "right", "wrong, accepted",
                  "most inliers of one not right", "its highest confidence"], rows),
        f"Wrong but accepted: {wrong} of {images}. Right: {right} of {all_usable} usable photos.",
    ])  # fmt: skip


def covariance(data: Row) -> str:
    """benchmarks/covariance.py."""
    rows = [
        [name, *(value(row, key) for key in ("accepted", "mean_nees", "median_nees", "inside_95"))]
        for name, row in data["sets"].items()
    ]
    calibrated = []
    for name, row in data["calibrated"].items():
        after = row.get("after")
        factor = f"{row['factor']:.2f}" if after else "too few"
        calibrated.append([
            name, str(row["poses"]), *_nees(row), str(row["calibrated_on"]), factor,
            *(_nees(after) if after else ("–", "–")),
        ])  # fmt: skip
    return "\n\n".join([
        "## Is the covariance true?", f"`python benchmarks/covariance.py --json out.json`. "
        f"{_facts(data)}",
        "True: NEES 6 on average, 95 % of the errors inside the 95 % ellipsoid. As maps are "
        "compiled, not calibrated:",
        markdown(["set", "poses", "mean NEES", "median NEES", "inside"], rows),
        "Calibrated (`igaussian map calibrate`), judged on poses that the calibration did not see:",
        markdown(["poses", "number", "mean NEES, before", "inside, before", "calibrated on",
                  "factor", "mean NEES", "inside"], calibrated),
    ])  # fmt: skip


def _nees(figures: Row) -> tuple[str, str]:
    return f"{figures['mean_nees']:.1f}", f"{100 * figures['inside_95']:.0f} %"


def stage_one(data: Row) -> str:
    """benchmarks/stage_one.py."""
    parts = [
        "## Stage one alone",
        f"`python benchmarks/stage_one.py --json out.json`. {_facts(data)}",
        "The first hypothesis, unverified. Distances are in map units; a photo's are followed by "
        "their share of the cameras' extent. Heads: the paper's candidates and weights of the "
        "source views; memory: kernel regression among thousands of views of known pose, by the "
        "same network's features; with one or two renders: corrected by what it says of those.",
    ]
    titles = {
        "maps": "Each map", "ablation": "What each part adds (table 4, stage one)",
        "views": "Number of source views (figure 5)",
    }  # fmt: skip
    for name, title in titles.items():
        if name in data:
            parts += [f"### {title}", _stage_one_table(data[name])]
    return "\n\n".join(parts)


def _stage_one_table(rows: Sequence[Row]) -> str:
    bins = list(rows[0]["groups"])
    head = ["map", "stage one", "predicts by", "training",
            *(f"{b}°: med °, distance, ≤ 15°" for b in bins),
            "photos: med °, distance, ≤ 15°", "ms"]  # fmt: skip
    return markdown(head, [
        [row["case"], row["method"], _head(row), _training(row),
         *(_errors(row["groups"][b]) for b in bins), _errors(row.get("photos"), row.get("extent")),
         value(row["rendered"], "median_ms")]
        for row in rows
    ])  # fmt: skip


_HEADS = {"attention": "heads", "memory": "memory", "": "–"}


def _head(row: Row) -> str:
    renders = ("", ", one render", ", two renders")[row.get("renders", 0)]
    return _HEADS[row["head"]] + renders


def _training(row: Row) -> str:
    return f"{row['steps']} steps, {row['train_s'] / 60:.1f} min" if "train_s" in row else "–"


def _errors(figures: Row | None, extent: float | None = None) -> str:
    if figures is None:
        return "–"
    distance = value(figures, "median_distance")
    if extent and figures["median_distance"] is not None:
        distance += f" ({figures['median_distance'] / extent:.1%})"
    median = figures["median_deg"]
    degrees = "–" if median is None else f"{median:.2f}"
    return f"{degrees}, {distance}, {value(figures, 'within_15_deg')}"


def scale(data: Row) -> str:
    """benchmarks/scale.py."""
    kinds = ("network", "depth", "constant")
    lengths = [[name, str(r["pairs"]), *(f"{100 * r[k]:.0f} %" for k in kinds)]
               for name, r in data["length"].items()]  # fmt: skip
    solvers = [[name, how, *(f"{100 * r[k]:.0f} %" for k in ("accepted", "success")),
                f"{r['deg']:.3f}", f"{r['cm']:.2f}"]
               for name, rows in data["solver"].items() for how, r in rows.items()]  # fmt: skip
    return "\n\n".join([
        "## The paper's learned scale",
        "`python benchmarks/scale.py --map lego.igmap --map room.igmap --each 8 "
        f"--json out.json`. {_facts(data)}",
        "Median relative error of the translation's length between a hypothesis and the image:",
        markdown(["maps", "pairs", "ViT", "rendered depth", "best constant"], lengths),
        "The paper's protocol without a prior; medians over accepted poses, map units as cm / 100:",
        markdown(["map", "solver, scale", "accepted", "within 5°, 5 cm", "med °", "med cm"],
                 solvers),
    ])  # fmt: skip
