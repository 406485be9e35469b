"""Where the paper's solver takes the translation's length from: `refine.scale`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from igaussian_core.camera import Camera
from igaussian_core.refine.relative import ScaleEstimator, depth_scale
from igaussian_core.refine.scale_vit import LearnedLength


@dataclass(frozen=True)
class ImagePair:
    """A photo, and the render at the hypothesis that it was matched with.

    Attributes:
        camera: pinhole, of both.
        image, render: uint8 RGB [H, W, 3].
        depth: of the render [H, W], scene units; counts where `covered` [H, W].
    """

    camera: Camera
    image: NDArray[np.uint8]
    render: NDArray[np.uint8]
    depth: NDArray[np.float32]
    covered: NDArray[np.bool_]


# what is opened once for a map: it gives the estimator of one pair of images
ScaleSource = Callable[[ImagePair], ScaleEstimator]


def by_depth() -> ScaleSource:
    """Rendered depths against triangulated ones; looks at the matches only."""
    return lambda pair: depth_scale


def by_network() -> ScaleSource:
    """The paper's: |t| of the relative pose that a network tells from the images.

    Raises:
        WeightsError: as `LearnedLength`.
    """
    length = LearnedLength()
    # run when asked, so not for a pair that shows a rotation only
    return lambda pair: lambda *matches: length(
        pair.camera, pair.render, pair.depth, pair.covered, pair.image
    )


SCALES: dict[str, Callable[[], ScaleSource]] = {"depth": by_depth, "vit": by_network}
