"""What reports share: one HTML page that needs no other file, and the look of its plots."""

from __future__ import annotations

import base64
import html
import io
import math
from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

GREY, BLUE, RED, ORANGE, GRID = "#8a939e", "#0b6fa4", "#c8322b", "#d9730d", "#e4e8ec"

STYLE = """
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


def page(title: str, lead: str, parts: Sequence[str]) -> str:
    """The document; `lead` is plain text, `parts` are HTML."""
    head = [
        "<!doctype html><html lang=en><meta charset=utf-8>",
        "<meta name=viewport content='width=device-width,initial-scale=1'>",
        f"<title>{html.escape(title)}</title><style>{STYLE}</style><main>",
        f"<h1>{html.escape(title)}</h1>",
        f"<p class=lead>{html.escape(lead)}</p>",
    ]
    return "\n".join([*head, *parts, "</main></html>"])


def new_figure(
    width: float, height: float, rows: int = 1, columns: int = 1
) -> tuple[Figure, Any]:
    """A figure with the reports' look and its axes: plots above each other share their x axis."""
    figure = Figure(figsize=(width, height), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, sharex=columns == 1, squeeze=False).ravel()
    for axis in axes:
        axis.grid(color=GRID, linewidth=0.8)
        axis.set_axisbelow(True)
        for side in ("top", "right"):
            axis.spines[side].set_visible(False)
    return figure, axes


def png(figure: Figure) -> bytes:
    """A figure as the bytes of a PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()


def cards(
    figures: Mapping[str, float],
    shown: Sequence[tuple[str, str, str, float, int]],
    failed: set[str] = frozenset(),  # type: ignore[assignment]
) -> str:
    """The most important figures, large.

    Args:
        shown: (name in figures, label, unit, factor, digits) of each card.
        failed: names marked as missed.
    """
    parts = []
    for name, label, unit, factor, digits in shown:
        value = figures.get(name, math.nan) * factor
        text = f"{value:.{digits}f}&nbsp;{unit}" if math.isfinite(value) else "–"
        kind = "card bad" if name in failed else "card"
        parts.append(f"<div class='{kind}'><b>{text}</b><span>{label}</span></div>")
    return f"<div class=cards>{''.join(parts)}</div>"


def pictures(images: Sequence[tuple[str, NDArray[np.uint8]]], caption: str) -> str:
    """Labelled images side by side over a caption in plain text."""
    cells = []
    for label, image in images:
        _, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 82])
        source = _data_url(data.tobytes(), "jpeg")
        cells.append(f"<div><img src='{source}' alt='{label}'><span>{label}</span></div>")
    return _framed(f"<div class=pair>{''.join(cells)}</div>", html.escape(caption))


def plot(data: bytes, caption: str) -> str:
    """A PNG over its caption."""
    return _framed(f"<img src='{_data_url(data, 'png')}' alt=''>", html.escape(caption))


def facts_table(rows: Mapping[str, str], failed: set[str] = frozenset()) -> str:  # type: ignore[assignment]
    """Two columns: name and value."""
    lines = []
    for name, value in rows.items():
        kind = " class=bad" if name in failed else ""
        lines.append(f"<tr{kind}><td>{html.escape(name)}</td><td>{html.escape(value)}</td></tr>")
    return f"<table>{''.join(lines)}</table>"


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of plain texts."""
    lines = ["<tr>" + "".join(f"<th>{html.escape(cell)}</th>" for cell in head) + "</tr>"]
    lines += ["<tr>" + "".join(f"<td>{html.escape(c)}</td>" for c in row) + "</tr>" for row in rows]
    return f"<table>{''.join(lines)}</table>"


def number(value: float) -> str:
    """A figure with four digits; a dash where there is none."""
    if not math.isfinite(value):
        return "–"
    return str(int(value)) if value == int(value) else f"{value:.4g}"


def _framed(content: str, caption: str) -> str:
    return f"<figure>{content}<figcaption>{caption}</figcaption></figure>"


def _data_url(data: bytes, kind: str) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
