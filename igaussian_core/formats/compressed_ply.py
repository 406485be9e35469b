"""SuperSplat's compressed .ply: 16 bytes a Gaussian, and optionally its harmonics at 8 bits.

Every 256 Gaussians share a row of element `chunk`, which holds the ranges of positions, log
scales and (in later files) colours; element `vertex` holds four packed uint32, highest bits
first: position and scale 11-10-11, rotation 2-10-10-10 (smallest three), colour 8-8-8-8.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import plyfile
from numpy.typing import NDArray

from igaussian_core.errors import MapError
from igaussian_core.formats.raw import SH_C0, RawGaussians, quats_from_smallest_three

_CHUNK = 256
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_SH_COLUMNS = (0, 9, 24, 45)


def is_compressed(ply: plyfile.PlyData) -> bool:
    """Whether the vertices are packed."""
    return set(_PACKED) <= set(ply["vertex"].data.dtype.names or ())


def decode(file: Path, ply: plyfile.PlyData) -> RawGaussians:
    """Unpack a compressed .ply.

    Raises:
        MapError: no chunks, too few, or harmonics that do not fit.
    """
    vertex = ply["vertex"].data
    if "chunk" not in ply:
        raise MapError(f"{file}: compressed .ply without element 'chunk'")
    chunk = ply["chunk"].data
    if len(chunk) * _CHUNK < len(vertex):
        raise MapError(f"{file}: compressed .ply: {len(chunk)} chunks for {len(vertex)} Gaussians")
    if any(vertex.dtype[name].kind != "u" for name in _PACKED):
        raise MapError(f"{file}: compressed .ply whose packed values are no unsigned integers")
    packed = {name: np.asarray(vertex[name], np.uint32) for name in _PACKED}
    colour = _fields(packed["packed_color"], (8, 8, 8, 8))
    try:
        means = _in_chunk(_fields(packed["packed_position"], (11, 10, 11)), chunk, "xyz", "")
        log_scales = _in_chunk(
            _fields(packed["packed_scale"], (11, 10, 11)), chunk, "xyz", "scale_"
        )
        rgb = colour[:, :3]
        if "min_r" in (chunk.dtype.names or ()):
            rgb = _in_chunk(rgb, chunk, "rgb", "")
    except ValueError as error:  # numpy's for a field that is not there
        raise MapError(f"{file}: compressed .ply: element 'chunk': {error}") from error
    small = (_fields(packed["packed_rotation"], (2, 10, 10, 10))[:, 1:] - 0.5) * np.float32(2**0.5)
    with np.errstate(over="ignore"):
        scales = np.exp(log_scales)
    dc = ((rgb - 0.5) / SH_C0).astype(np.float32)
    return RawGaussians(
        means=means,
        quats_wxyz=quats_from_smallest_three(packed["packed_rotation"] >> 30, small),
        scales=scales,
        opacities=colour[:, 3].copy(),
        sh=np.concatenate([dc[:, None], _harmonics(file, ply)], axis=1),
        file_format=".ply, SuperSplat compressed",
    )


def _fields(packed: NDArray[np.uint32], bits: tuple[int, ...]) -> NDArray[np.float32]:
    """The bit fields [N, len(bits)], highest first, each scaled to [0, 1]."""
    fields = np.empty((len(packed), len(bits)), np.float32)
    shift = 32
    for i, width in enumerate(bits):
        shift -= width
        fields[:, i] = (packed >> shift & ((1 << width) - 1)) / np.float32((1 << width) - 1)
    return fields


def _in_chunk(
    unit: NDArray[np.float32], chunk: NDArray[Any], axes: str, prefix: str
) -> NDArray[np.float32]:
    """Values in [0, 1] taken to the ranges of the chunk that each Gaussian lies in."""
    low, high = (
        np.stack([np.asarray(chunk[f"{end}_{prefix}{axis}"], np.float32) for axis in axes], axis=1)
        for end in ("min", "max")
    )
    index = np.arange(len(unit)) // _CHUNK
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(low[index] * (1 - unit) + high[index] * unit)


def _harmonics(file: Path, ply: plyfile.PlyData) -> NDArray[np.float32]:
    """Harmonics beyond the constant one, [N, K - 1, 3]: bytes that span -4 to 4."""
    count = len(ply["vertex"].data)
    if "sh" not in ply:
        return np.zeros((count, 0, 3), np.float32)
    data = ply["sh"].data
    names = [n for n in data.dtype.names or () if n.startswith("f_rest_")]
    complete = all(f"f_rest_{i}" in names for i in range(len(names)))
    if len(data) != count or len(names) not in _SH_COLUMNS or not complete:
        raise MapError(
            f"{file}: compressed .ply: {len(names)} f_rest properties for {len(data)} of {count} "
            "Gaussians"
        )
    sh = np.empty((count, len(names) // 3, 3), np.float32)
    for i in range(len(names)):
        byte = np.asarray(data[f"f_rest_{i}"], np.float32)
        # the lowest and the highest byte stand for the range's ends, others for bin centres
        unit = np.where(byte == 0, 0, np.where(byte == 255, 1, (byte + 0.5) / 256))
        channel, coefficient = divmod(i, len(names) // 3)
        sh[:, coefficient, channel] = (unit - 0.5) * 8
    return sh
