"""The .splat format: 32 bytes a Gaussian, no header, no spherical harmonics beyond the colour.

Position 3 x float32, linear scale 3 x float32, RGBA 4 x uint8, quaternion wxyz 4 x uint8.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from igaussian_core.errors import MapError
from igaussian_core.formats.raw import SH_C0, RawGaussians

_RECORD = np.dtype(
    [("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat_wxyz", "u1", 4)]
)


def read(file: Path) -> RawGaussians:
    """Read a .splat file.

    Raises:
        MapError: empty, or no whole number of records.
    """
    size = file.stat().st_size
    if size == 0 or size % _RECORD.itemsize:
        raise MapError(
            f"{file}: {size} bytes are no whole number of {_RECORD.itemsize}-byte records: "
            "truncated, or no .splat file"
        )
    data = np.fromfile(file, _RECORD)
    rgba = data["rgba"].astype(np.float32) / np.float32(255)
    scales = data["scale"].copy()
    scales[scales < 0] = np.nan  # never written by an exporter: left out as damaged
    return RawGaussians(
        means=data["mean"].copy(),
        quats_wxyz=(data["quat_wxyz"].astype(np.float32) - 128) / np.float32(128),
        scales=scales,
        opacities=rgba[:, 3].copy(),
        sh=((rgba[:, None, :3] - 0.5) / SH_C0).astype(np.float32),
        file_format=".splat",
    )
