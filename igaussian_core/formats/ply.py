"""Gaussians in .ply files: INRIA's layout, and SuperSplat's packed one."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import plyfile
from numpy.typing import NDArray

from igaussian_core.errors import MapError
from igaussian_core.formats import compressed_ply
from igaussian_core.formats.raw import RawGaussians

SH_DEGREES = {0: 0, 9: 1, 24: 2, 45: 3}  # number of f_rest properties -> degree
_ROWS_AT_ONCE = 1 << 15  # a block of rows stays in the cache while its columns are taken out
_MOST_HEADER_BYTES = 1 << 16
_PLY_ERRORS = (plyfile.PlyParseError, ValueError, OSError, EOFError, UnicodeDecodeError)


def read(file: Path) -> RawGaussians:
    """Read a .ply of Gaussians, INRIA's or SuperSplat's.

    INRIA's layout in any order of properties, binary or ascii, float or double, SH degree 0
    to 3, with or without normals and extra properties; Mip-Splatting's filter_3D is applied.

    Raises:
        MapError: truncated, or without the properties of Gaussians.
    """
    _check_declared_sizes(file)
    try:
        ply = plyfile.PlyData.read(str(file))
    except _PLY_ERRORS as error:
        raise MapError(
            f"{file}: not a readable .ply ({error or type(error).__name__}); "
            "supported: .ply of 3D Gaussians"
        ) from error
    if "vertex" not in ply:
        raise MapError(f"{file}: no element 'vertex'; supported: .ply of 3D Gaussians")
    if compressed_ply.is_compressed(ply):
        return compressed_ply.decode(file, ply)
    vertex = ply["vertex"].data
    _check_properties(file, vertex.dtype)
    return _decode(vertex, *_hints(ply.comments))


def write(gaussians: RawGaussians, file: Path) -> None:
    """Write INRIA's binary little-endian .ply (float32, no normals)."""
    count, coefficients = gaussians.sh.shape[:2]
    rest = np.transpose(gaussians.sh[:, 1:], (0, 2, 1)).reshape(count, 3 * (coefficients - 1))
    opacity = np.clip(gaussians.opacities.astype(np.float64), 1e-7, 1 - 1e-7)
    scales = gaussians.scales
    columns: list[tuple[str, NDArray[Any]]] = [
        *zip("xyz", gaussians.means.T, strict=True),
        *((f"f_dc_{i}", gaussians.sh[:, 0, i]) for i in range(3)),
        *((f"f_rest_{i}", rest[:, i]) for i in range(3 * (coefficients - 1))),
        ("opacity", np.log(opacity / (1 - opacity))),
        *((f"scale_{i}", np.log(np.maximum(scales[:, i], 1e-30))) for i in range(3)),
        *((f"rot_{i}", gaussians.quats_wxyz[:, i]) for i in range(4)),
    ]
    vertex = np.empty(count, dtype=[(name, "<f4") for name, _ in columns])
    for name, values in columns:
        vertex[name] = values
    comments = ["SplatRenderMode: mip"] if gaussians.antialiased else []
    if gaussians.vertical_axis:
        comments.append(f"Vertical axis: {gaussians.vertical_axis}")
    element = plyfile.PlyElement.describe(vertex, "vertex")
    plyfile.PlyData([element], byte_order="<", comments=comments).write(str(file))


def _check_declared_sizes(file: Path) -> None:
    """Refuse a header that declares more than the file holds, before anything is allocated."""
    with open(file, "rb") as stream:
        head = stream.read(_MOST_HEADER_BYTES)
    end = re.search(rb"end_header[ \t]*\r?\n", head)
    header = head[: end.start()] if end else head
    ascii_text = re.search(rb"^format\s+ascii", header, re.MULTILINE) is not None
    least = 0
    for block in re.split(rb"^element\s", header, flags=re.MULTILINE)[1:]:
        lines = [line.split() for line in block.splitlines()]
        types = [line[1] for line in lines[1:] if len(line) > 2 and line[0] == b"property"]
        # ascii: a digit and a space; a list: at least its length
        row = sum(2 if ascii_text else _TYPE_BYTES.get(name, 1) for name in types)
        if lines and len(lines[0]) > 1 and lines[0][1].isdigit():
            least += int(lines[0][1]) * max(row, 1)
    size = file.stat().st_size
    if least > size:
        raise MapError(f"{file}: not a readable .ply: truncated (its header declares {least} "
                       f"bytes or more, the file has {size})")  # fmt: skip


_TYPE_BYTES = {
    name: size
    for size, names in {
        1: b"char uchar int8 uint8", 2: b"short ushort int16 uint16",
        4: b"int uint int32 uint32 float float32", 8: b"double float64",
    }.items()
    for name in names.split()
}  # fmt: skip


def _check_properties(file: Path, dtype: np.dtype[Any]) -> None:
    names = dtype.names or ()
    needed = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
    needed += [f"scale_{i}" for i in range(3)] + [f"rot_{i}" for i in range(4)]
    missing = [name for name in needed if name not in names]
    if missing:
        raise MapError(
            f"{file}: no 3D Gaussian map: properties {', '.join(missing)} are missing "
            "(a plain point cloud or mesh cannot be localized against)"
        )
    rest = sum(name.startswith("f_rest_") for name in names)
    if rest not in SH_DEGREES:
        raise MapError(
            f"{file}: {rest} f_rest properties; spherical harmonics of degree 0 to 3 have "
            f"{', '.join(map(str, SH_DEGREES))}"
        )
    needed += [f"f_rest_{i}" for i in range(rest)]
    unusable = [name for name in needed if name not in names or dtype[name].kind not in "fiu"]
    if unusable:
        raise MapError(f"{file}: properties {', '.join(unusable)} are missing or no plain numbers")


def _hints(comments: list[str]) -> tuple[bool, str]:
    """Antialiased or not, and the axis that points up ("" unknown), as comments tell."""
    text = "\n".join(comments).lower()
    axis = re.search(r"vertical[ _]axis\s*[:=]\s*([xyz])\b", text)
    return "splatrendermode: mip" in text, axis.group(1) if axis else ""


def _decode(vertex: NDArray[Any], antialiased: bool, vertical_axis: str) -> RawGaussians:
    names = [name for name in vertex.dtype.names or () if vertex.dtype[name].kind in "fiu"]
    count, rest = len(vertex), sum(name.startswith("f_rest_") for name in names)
    raw = RawGaussians(
        means=np.empty((count, 3), np.float32),
        quats_wxyz=np.empty((count, 4), np.float32),
        scales=np.empty((count, 3), np.float32),
        opacities=np.empty(count, np.float32),
        sh=np.empty((count, 1 + rest // 3, 3), np.float32),
        antialiased=antialiased,
        file_format=".ply",
        vertical_axis=vertical_axis,
    )
    for start in range(0, count, _ROWS_AT_ONCE):
        block = slice(start, start + _ROWS_AT_ONCE)
        _decode_rows(_matrix(vertex[block], names), names, rest, raw, block)
    return raw


def _matrix(rows: NDArray[Any], names: list[str]) -> NDArray[Any]:
    """Columns of a structured array as a float matrix [N, names], native byte order."""
    types = {rows.dtype[name] for name in names}
    if len(types) == 1 and rows.dtype.itemsize == len(names) * next(iter(types)).itemsize:
        uniform = np.ascontiguousarray(rows).view(next(iter(types))).reshape(len(rows), -1)
        return uniform.astype(np.result_type(np.float32, uniform.dtype.newbyteorder("=")))
    return np.stack([np.asarray(rows[name], np.float64) for name in names], axis=1)


def _decode_rows(
    rows: NDArray[Any], names: list[str], rest: int, raw: RawGaussians, block: slice
) -> None:
    def columns(*wanted: str) -> NDArray[Any]:
        index = [names.index(name) for name in wanted]
        if index == list(range(index[0], index[0] + len(index))):
            return rows[:, index[0] : index[-1] + 1]
        return rows[:, index]

    def of_prefix(prefix: str, count: int) -> NDArray[Any]:
        return columns(*(f"{prefix}{i}" for i in range(count)))

    with np.errstate(over="ignore", invalid="ignore"):
        scales = np.exp(of_prefix("scale_", 3).astype(np.float64))
        opacities = 1 / (1 + np.exp(-columns("opacity")[:, 0].astype(np.float64)))
        if "filter_3D" in names:
            filter_3d = columns("filter_3D").astype(np.float64)
            scales, opacities = _apply_filter_3d(scales, opacities, filter_3d)
        raw.means[block] = columns("x", "y", "z")
        raw.quats_wxyz[block] = of_prefix("rot_", 4)
        raw.scales[block] = scales
        raw.opacities[block] = opacities
        raw.sh[block, 0] = of_prefix("f_dc_", 3)
        if rest:
            # the file counts channel by channel: f_rest_{c * (K - 1) + k}
            by_channel = of_prefix("f_rest_", rest).reshape(len(rows), 3, rest // 3)
            raw.sh[block, 1:] = by_channel.transpose(0, 2, 1)


def _apply_filter_3d(
    scales: NDArray[np.float64], opacities: NDArray[np.float64], filter_3d: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mip-Splatting's 3D smoothing filter (Yu et al., 2024, eq. 9): wider, less opaque."""
    wide = np.sqrt(scales**2 + filter_3d**2)
    return wide, opacities * np.prod(scales / np.maximum(wide, 1e-30), axis=1)
