"""What stage one hands to stage two."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Hypothesis:
    """A place where the camera may be.

    Attributes:
        T_scene_cam: 4x4 float64.
        score: the larger the better; comparable among hypotheses of one source only.
        source: "prior", "landmarks", "network".
        align: whether stage two aligns here; not where it did so before in vain.
        describe: whether it may match descriptors where alignment does not convince.
        rival: another place, 4x4, that explains nearly as much of the image; None: none known.
    """

    T_scene_cam: NDArray[np.float64]
    score: float
    source: str
    align: bool = True
    describe: bool = True
    rival: NDArray[np.float64] | None = None
