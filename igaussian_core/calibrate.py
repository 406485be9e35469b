"""How much larger a map's errors are than its covariance says, measured on photos with poses."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from igaussian_core.config import Config
from igaussian_core.errors import DatasetError
from igaussian_core.evaluate.metrics import NEES_95, normalized_error_squared
from igaussian_core.evaluate.photos import PhotoQueries, folder_of, held_out_images
from igaussian_core.geometry import pose_error
from igaussian_core.localizer import Localizer
from igaussian_core.map_package import MapPackage, open_package, with_covariance_scale
from igaussian_core.posed_images import PosedImage

log = logging.getLogger(__name__)

MIN_POSES = 12  # with fewer, one more photo changes the factor by half
_DEFAULT_POSES = 2  # whose worth the default counts
_DEGREES_OF_FREEDOM = 6
_RANGE = (0.01, 1e4)
_MAX_ERROR_DEG = 5.0  # beyond it a pose is wrong, which no covariance is meant to cover


@dataclass(frozen=True)
class Calibration:
    """What photos say of a map's covariance.

    Attributes:
        scale: what the covariance is multiplied by.
        poses: accepted poses that it was measured on.
        photos: that were tried.
        mean_nees, inside_95: before: 6 and 0.95 where the covariance is true.
        held_out: whether the map is known not to have been trained on these photos.
    """

    scale: float
    poses: int
    photos: int
    mean_nees: float
    inside_95: float
    held_out: bool


def calibrate_map(
    path: str | Path,
    photos: str | Path,
    map_note: str | Path | None = None,
    config: Config | None = None,
    progress: Callable[[str, int, int], None] = lambda stage, done, of: None,
) -> Calibration:
    """Measure a compiled map's covariance scale and write it into its manifest.

    Args:
        photos: poses.json or the like; where a `map.json` beside it (or `map_note`) names the
            photos that the map was trained on, only the others are used.

    Raises:
        MapError, DatasetError: unusable input, fewer than 12 accepted poses; the manifest is
            left as it was then.
    """
    images, held_out = _photos(photos, map_note)
    found = calibrate(open_package(path), images, config, progress)
    with_covariance_scale(path, found.scale, found.poses)
    return dataclasses.replace(found, held_out=held_out)


def calibrate(
    package: MapPackage,
    images: Sequence[PosedImage],
    config: Config | None = None,
    progress: Callable[[str, int, int], None] = lambda stage, done, of: None,
) -> Calibration:
    """As `calibrate_map`, of photos in hand, which are taken to be held out; writes nothing.

    Raises:
        DatasetError: fewer than 12 accepted poses.
    """
    plain = dataclasses.replace(package.manifest, covariance_scale=1.0)
    localizer = Localizer(dataclasses.replace(package, manifest=plain), config)
    red, green, blue = plain.background
    queries = PhotoQueries(tuple(images), package.T_map_scene, (red, green, blue))
    nees = []
    for index in range(len(queries)):
        result = localizer.localize(*queries.image(index))
        truth = queries.truth(index)
        progress("photos", index + 1, len(queries))
        if result.T_map_cam is None or result.covariance is None:
            continue
        if pose_error(result.T_map_cam, truth)[0] < _MAX_ERROR_DEG:
            nees.append(normalized_error_squared(result.T_map_cam, result.covariance, truth))
    if len(nees) < MIN_POSES:
        raise DatasetError(
            f"{len(nees)} of {len(images)} photos were localized; a covariance is calibrated on "
            f"{MIN_POSES} at least"
        )
    values = np.array(nees)
    return Calibration(
        covariance_scale(values), len(values), len(images), float(values.mean()),
        float((values < NEES_95).mean()), held_out=True,
    )  # fmt: skip


def covariance_scale(nees: ArrayLike) -> float:
    """The factor [0.01 to 10,000] that makes e^T C^-1 e [N] what six numbers' should be.

    That is a mean of 6, or, where the errors' tail is longer than a normal distribution's, 95 %
    inside the 95 % ellipsoid: the larger of both. The default, 1, counts as two more poses: few
    photos tell little, and a covariance too small does more harm than one too large.
    """
    values: NDArray[np.float64] = np.asarray(nees, np.float64)
    by_mean = float(values.mean()) / _DEGREES_OF_FREEDOM
    by_tail = float(np.quantile(values, 0.95)) / NEES_95
    measured = len(values) * max(by_mean, by_tail)
    return float(
        np.clip((measured + _DEFAULT_POSES) / (len(values) + _DEFAULT_POSES), *_RANGE)
    )


def _photos(
    photos: str | Path, map_note: str | Path | None
) -> tuple[list[PosedImage], bool]:
    """The photos to measure on, and whether they are known to be held out."""
    note = Path(map_note) if map_note else folder_of(photos) / "map.json"
    if note.is_file():
        try:
            return held_out_images(photos, note), True
        except DatasetError as error:
            log.warning("%s: all photos are used", error)
    else:
        log.warning(
            "%s: no list of the photos that the map was trained on; on those it errs less than "
            "elsewhere, and the covariance will be too small", note,
        )  # fmt: skip
    return held_out_images(photos, None, allow_training=True), False
