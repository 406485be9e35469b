"""Markdown of the figures in benchmarks/results: what docs/benchmarks.md is made of."""

from __future__ import annotations

from collections.abc import Sequence
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
    return _layout(name, rows) + _missing(rows)


def _missing(rows: Sequence[Row]) -> str:
    needs = sorted({row["not_built"] for row in rows if "not_built" in row})
    return "".join(f"\n\nRows that are not built need {need}." for need in needs)


def _layout(name: str, rows: Sequence[Row]) -> str:
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
        if "not_built" in row:
            cells = ["not built", *["–"] * (len(head) - 3)]
        else:
            groups = row["groups"]
            cells = [_count(row), *(value(groups[b], key) for b in bins for key in keys)]
        lines.append([row["case"], row["method"], *cells])
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
        if "not_built" in row:
            cells = ["not built", *["–"] * (len(head) - 3)]
        else:
            cells = [_count(row), *(value(row["summary"], key) for key, _ in _OVERALL)]
        lines.append([row["case"], row["method"], *cells])
    return markdown(head, lines)


def _count(row: Row) -> str:
    steps = f", {row['iterations']} steps" if "iterations" in row else ""
    return f"{row['summary']['queries']}{steps}"


def value(figures: Row, key: str) -> str:
    """One figure: shares in per cent, times in whole milliseconds, a dash for none."""
    number = figures.get(key)
    if number is None:
        return "–"
    if key in ("success", "within_15_deg", "within_half_unit", "auc", "inside_95"):
        return f"{100 * number:.1f} %"
    if key in ("wrong_accepted", "queries"):
        return str(int(number))
    if key.endswith("ms"):
        return f"{number:.0f}"
    return f"{number:.3f}" if key.endswith("deg") else f"{number:.4f}"
