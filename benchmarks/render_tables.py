"""The section of docs/benchmarks.md on rendering, from the JSON of benchmarks/render.py."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tables import markdown

Row = dict[str, Any]

# Gaussians, threads, milliseconds
GOALS = (
    (100_000, 2, 4.0), (500_000, 2, 8.0), (1_000_000, 2, 16.0),
    (100_000, 1, 7.5), (500_000, 1, 14.5), (1_000_000, 1, 28.0),
)  # fmt: skip
# OpenSplat's CPU rasterizer (C++, no depth), wall milliseconds for rooms of as many Gaussians at
# 640x480 on such a machine, measured when the design was chosen
OPENSPLAT_MS = {50_000: 710, 500_000: 1400}
_INTRO = """640x480, SH 3, RGB with expected depth and alpha; rooms of surface-aligned Gaussians
that the script makes, and trained maps at their own cameras. Medians, in parentheses the quartiles;
CPU time for one thread, wall time for two, which suffers where other work runs; "least" is the
fastest frame. Projection, sorting and blending in per cent of the busy time. AVX2 and portable:
times the CPU time of the best path, one thread."""


def section(data: Row) -> str:
    """benchmarks/render.py."""
    parts = ["## Rendering", *_head(data, ""), "### Goals", _goals(data["scenes"])]
    if any("accuracy" in scene for scene in data["scenes"]):
        parts += ["### Accuracy against the float64 reference", _ACCURACY, _accuracy(data)]
    parts += ["### Gradients and batches", _gradients(data["scenes"])]
    if "memory" in data:
        parts += ["### Memory", _memory(data["memory"])]
    if "peers" in data:
        parts += ["### Other renderers, 50,000 Gaussians", _peers(data["peers"], data["scenes"])]
    return "\n\n".join(parts)


def section_of_another_machine(data: Row) -> str:
    """benchmarks/render.py where there is no AVX-512: its times alone."""
    parts = [
        "## Rendering without AVX-512",
        *_head(data, " --no-oracle"),
        "The goals above are for AVX-512 and not judged here.",
        _gradients(data["scenes"]),
    ]
    return "\n\n".join(parts)


def _head(data: Row, options: str) -> list[str]:
    facts = "; ".join(f"{k}: {v}" for k, v in data["facts"].items())
    command = f"`python benchmarks/render.py --json out.json{options}`. {facts}"
    return [command, _INTRO, _times(data["scenes"])]


def _spread(quartiles: Sequence[float]) -> str:
    low, median, high = quartiles
    return f"{median:.1f} ({low:.1f} to {high:.1f})"


def _path(scene: Row, simd: str | None, threads: int) -> Row:
    """The kernel's row of one instruction set, or of the best."""
    rows = [row for row in scene["kernel"] if row["threads"] == threads]
    return next(row for row in rows if simd in (None, row["simd"]))


def _times(scenes: Sequence[Row]) -> str:
    best = scenes[0]["kernel"][0]["simd"]
    slower = [s for s in ("avx2", "portable") if s != best and _has(scenes[0], s)]
    head = ["scene", f"1 thread, CPU ms, {best}", "least", "2 threads, wall ms", "least",
            "project, sort, blend %", *(f"{name}, times" for name in slower)]  # fmt: skip
    lines = []
    for scene in scenes:
        one, two = _path(scene, None, 1), _path(scene, None, 2)
        lines.append([
            scene["scene"], _spread(one["cpu_ms"]), f"{one['least_cpu_ms']:.1f}",
            _spread(two["wall_ms"]), f"{two['least_wall_ms']:.1f}",
            ", ".join(f"{share:.0f}" for share in one["project_sort_blend_percent"]),
            *(f"{_ratio(scene, name):.1f}" for name in slower),
        ])  # fmt: skip
    return markdown(head, lines)


def _has(scene: Row, simd: str) -> bool:
    return any(row["simd"] == simd for row in scene["kernel"])


def _ratio(scene: Row, simd: str) -> float:
    return float(_path(scene, simd, 1)["cpu_ms"][1] / _path(scene, None, 1)["cpu_ms"][1])


def _goals(scenes: Sequence[Row]) -> str:
    rows = []
    for count, threads, limit in GOALS:
        for scene in _rooms(scenes, count):
            row = _path(scene, None, threads)
            kind = "wall" if threads == 2 else "cpu"
            what = f"{count:,} Gaussians, {threads} thread{'s' * (threads - 1)}, ms"
            rows.append(_at_most(what, row[f"{kind}_ms"][1], limit, row[f"least_{kind}_ms"]))
    for name, limit in (("avx2", 2.5), ("portable", 10.0)):
        rooms = [s for s in scenes if s["scene"].startswith("room") and _has(s, name)]
        if rooms:
            worst = max(_ratio(scene, name) for scene in rooms)
            rows.append(_at_most(f"{name}, times the best path, worst room", worst, limit))
    rows += _faster_than(scenes)
    for key, limit, what in (
        ("rgb_max", 2e-3, "RGB, largest difference from the reference"),
        ("depth_max", 1e-3, "depth, largest relative difference"),
    ):
        for scene in scenes:
            if "accuracy" in scene:
                value = scene["accuracy"][0][key]
                rows.append(_at_most(f"{what}, {scene['scene']}", value, limit))
    return markdown(["goal", "limit", "reached", ""], rows)


def _rooms(scenes: Sequence[Row], count: int) -> list[Row]:
    return [s for s in scenes if s["gaussians"] == count and s["scene"].startswith("room")]


def _at_most(what: str, value: float, limit: float, least: float | None = None) -> list[str]:
    met = "met" if value <= limit else f"missed, {value / limit:.2f} times the limit"
    if value > limit and least is not None and least <= limit:
        met += "; least within it"
    reached = f"{value:.2g}" if value < 0.1 else f"{value:.1f}"
    return [what, f"at most {limit:g}", reached, met]


def _faster_than(scenes: Sequence[Row]) -> list[list[str]]:
    rows = []
    for scene in scenes:
        ours = _path(scene, None, 1)["cpu_ms"][1]
        if "oracle" in scene:
            ratio, limit = scene["oracle"]["cpu_ms"] / ours, 150
            met = "met" if ratio >= limit else f"missed, {ratio / limit:.2f} of it"
            what = f"torch reference, CPU time over ours, {scene['scene']}"
            rows.append([what, f"at least {limit}", f"{ratio:.0f}", met])
    for count, theirs in OPENSPLAT_MS.items():
        for scene in _rooms(scenes, count):
            ratio = theirs / _path(scene, None, 1)["cpu_ms"][1]
            met = "met" if ratio >= 40 else f"missed, {ratio / 40:.2f} of it"
            what = f"OpenSplat's {theirs} ms over ours, {count:,}"
            rows.append([what, "at least 40", f"{ratio:.0f}", met])
    return rows


_ACCURACY = """Of 307,200 pixels, largest of the three channels; depth where alpha > 0.5. What
remains above 2e-3 is what the equations leave to rounding: an alpha at just 1/255, a transmittance
at just 1e-4. The last row of each scene is the reference itself in float32, which besides confuses
the order of near-equal depths."""


def _accuracy(data: Row) -> str:
    head = ["scene", "path", "RGB 99 %", "RGB max", "pixels above 2e-3", "depth 99.99 %",
            "depth max"]  # fmt: skip
    rows = [
        [scene["scene"], a["of"], f"{a['rgb_99_percent']:.1e}", f"{a['rgb_max']:.1e}",
         str(a["rgb_pixels_above_2e-3"]), f"{a['depth_99_99_percent']:.1e}",
         f"{a['depth_max']:.1e}"]
        for scene in data["scenes"]
        for a in scene.get("accuracy", ())
    ]  # fmt: skip
    return markdown(head, rows)


def _gradients(scenes: Sequence[Row]) -> str:
    head = ["scene", "forward and backward, 1 thread, CPU ms", "times forward",
            "packing a map, CPU ms", "64 views of 64x64, one call, ms", "one by one, ms",
            "views a second", "CPU ms a view"]  # fmt: skip
    rows = []
    for scene in scenes:
        if "gradients" not in scene:
            continue
        gradients, batch = scene["gradients"], scene["batch"]
        ratio = gradients["cpu_ms"][1] / _path(scene, None, 1)["cpu_ms"][1]
        rows.append([
            scene["scene"], _spread(gradients["cpu_ms"]), f"{ratio:.1f}",
            f"{gradients['packing_cpu_ms']:.0f}", _spread(batch["batch_wall_ms"]),
            _spread(batch["one_by_one_wall_ms"]),
            f"{1e3 * batch['views'] / batch['batch_wall_ms'][1]:.0f}",
            f"{batch['batch_cpu_ms'][1] / batch['views']:.2f}",
        ])  # fmt: skip
    return markdown(head, rows)


def _memory(memory: Row) -> str:
    head = ["Gaussians", "arrays, MB", "packed for the kernel, MB", "image",
            "packed and frame buffers, MB", "2 threads, wall ms"]  # fmt: skip
    rows = [
        [f"{memory['gaussians']:,}", str(memory["arrays_mb"]), str(memory["packed_mb"]), size,
         str(memory[size]["with_frame_buffers_mb"]), _spread(memory[size]["wall_ms"])]
        for size in ("640x480", "1920x1080")
    ]  # fmt: skip
    return markdown(head, rows)


def _peers(peers: Sequence[Row], scenes: Sequence[Row]) -> str:
    rows = []
    for scene in _rooms(scenes, 50_000):
        ours = _path(scene, None, 1)
        cpu = f"{ours['cpu_ms'][1]:.1f}"
        rows.append(["iGaussian", f"{ours['simd']}, whole frame", cpu])
        if "oracle" in scene:
            cpu = str(scene["oracle"]["cpu_ms"])
            rows.append(["iGaussian", "torch reference, 32-pixel tiles, whole frame", cpu])
    for peer in peers:
        figure = str(peer["cpu_ms"]) if "cpu_ms" in peer else peer["reason"]
        rows.append([peer["name"].strip(), peer["what"], figure])
    return markdown(["renderer", "what", "CPU ms, 1 thread"], rows)
