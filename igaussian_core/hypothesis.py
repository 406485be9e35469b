"""What stage one hands to stage two."""

from __future__ import annotations

from collections.abc import Iterable
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
        others: other places, 4x4, that the image may show as well, the likeliest first; looked
            through once, and only where this one is accepted.
    """

    T_scene_cam: NDArray[np.float64]
    score: float
    source: str
    align: bool = True
    describe: bool = True
    others: Iterable[NDArray[np.float64]] = ()
