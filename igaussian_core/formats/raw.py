"""What every reader returns, and checks that several of them need."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from igaussian_core.errors import MapError

Array = NDArray[np.float32]

SH_C0 = 0.28209479177387814  # Y_0^0: colour = 0.5 + SH_C0 * f_dc
_ALWAYS_PLAUSIBLE = 1_000_000


@dataclass
class RawGaussians:
    """Gaussians as a file gave them, activated but not validated.

    Attributes:
        means: [N, 3] float32, in the frame of the INRIA .ply that the file was made from.
        quats_wxyz: [N, 4] float32 of any length.
        scales: [N, 3] float32, linear.
        opacities: [N] float32 in [0, 1].
        sh: [N, K, 3] float32, K in 1, 4, 9, 16.
        antialiased: the file says that it was trained with opacity compensation.
        file_format: what the file is, for people.
        vertical_axis: "x", "y" or "z" where the file names the axis that points up, else "".
    """

    means: Array
    quats_wxyz: Array
    scales: Array
    opacities: Array
    sh: Array
    antialiased: bool = False
    file_format: str = ""
    vertical_axis: str = ""


def check_plausible(file: Path, count: int, stored_bytes: int) -> None:
    """Refuse a declared count that no honest file of this size holds, before allocating for it.

    Compressed Gaussians take 8 bytes or more; repeated ones take fewer, hence the leeway.
    """
    if count > max(_ALWAYS_PLAUSIBLE, 4 * stored_bytes):
        raise MapError(
            f"{file}: declares {count} Gaussians in {stored_bytes} bytes: the header is damaged"
        )


def quats_from_smallest_three(
    largest: NDArray[np.integer], small: Array, order: tuple[int, int, int, int] = (0, 1, 2, 3)
) -> Array:
    """Unit quaternions wxyz [N, 4] of the index of the largest component and the other three.

    Args:
        largest: [N] place of the omitted component in the file's order.
        small: [N, 3] the other components, in the file's order.
        order: `order[i]` is the file's place of component i of w, x, y, z.
    """
    missing = np.sqrt(np.maximum(0, 1 - np.sum(small * small, axis=1)))
    quats = np.empty((len(small), 4), np.float32)
    for i, place in enumerate(order):
        # components before the omitted one keep their place, later ones move up by one
        quats[:, i] = np.where(
            largest == place,
            missing,
            np.where(place < largest, small[:, min(place, 2)], small[:, max(place - 1, 0)]),
        )
    return quats
