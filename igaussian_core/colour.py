"""Affine colour fit: the exposure and white balance between a render and a camera's image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from igaussian_core.errors import ImageError

Array = NDArray[np.float64]

_LEAST_PIXELS = 32
_MOST_PIXELS = 10_000  # gains to a thousandth at 1 % of noise
_HUBER = 1.345  # in standard deviations: 95 % efficient on normal noise (Huber, 1964)
_SATURATED = (0.01, 0.99)
_PLAUSIBLE_GAIN = 3.5
_PLAUSIBLE_RESIDUAL = 0.08


@dataclass(frozen=True)
class ColourFit:
    """image = gain * render + offset, each channel by itself, colours in [0, 1].

    Attributes:
        gain: [3] float64.
        offset: [3] float64.
        residual: [3] robust standard deviation of what the fit leaves, colours in [0, 1].
        inliers: share of the used pixels within three of these, in all channels.
        pixels: how many pixels were used.
    """

    gain: Array
    offset: Array
    residual: Array
    inliers: float
    pixels: int

    @staticmethod
    def identity() -> ColourFit:
        """The fit that changes nothing, where there was too little to fit."""
        return ColourFit(np.ones(3), np.zeros(3), np.full(3, np.nan), 0.0, 0)

    @property
    def plausible(self) -> bool:
        """Whether this may be one scene under two exposures: gains off their bounds, little left.

        Of held-out photos of five scenes the fit leaves 0.013 to 0.034 at their true poses, 0.11
        and more at the poses of others.
        """
        sane = (self.gain < _PLAUSIBLE_GAIN) & (self.gain > 1 / _PLAUSIBLE_GAIN)
        return self.pixels > 0 and bool((sane & (self.residual < _PLAUSIBLE_RESIDUAL)).all())

    def apply(self, render: ArrayLike) -> NDArray[np.float32]:
        """Render [..., 3] with the image's exposure and white balance, not clipped.

        Integers are taken to be in [0, 255]; the result is float32 with 1 for white.
        """
        return np.asarray(_unit(render) * self.gain + self.offset, np.float32)


def fit_colour(
    image: ArrayLike,
    render: ArrayLike,
    mask: ArrayLike | None = None,
    max_gain: float = 4.0,
) -> ColourFit:
    """Robust gain and offset by channel that take a render's colours to an image's.

    A repeated-median start (Siegel, 1982; half of the pixels may be outliers) and iteratively
    reweighted least squares with Huber's weights; pixels beyond three deviations get none.
    Saturated pixels of the image are left out: they do not follow the model.

    Args:
        image, render: [H, W, 3], or [N, 3]; integers in [0, 255] or floats in [0, 1].
        mask: [H, W] or [N] bool, pixels that may be used, such as alpha > 0.9.
        max_gain: gains are kept within 1 / max_gain and max_gain. A channel that the render
            shows flat has no gain of its own: it keeps 1, and the offset takes the rest.

    Returns:
        The fit; `ColourFit.identity()` where fewer than 32 pixels are usable.

    Raises:
        ImageError: sizes that differ.
    """
    target, source = np.asarray(image), np.asarray(render)
    if target.shape != source.shape or target.shape[-1:] != (3,):
        raise ImageError(f"colour fit: image is {target.shape}, render is {source.shape}")
    allowed = np.ones(target.shape[:-1], bool) if mask is None else np.asarray(mask, bool)
    if allowed.shape != target.shape[:-1]:
        raise ImageError(f"colour fit: mask is {allowed.shape}, image is {target.shape[:-1]}")
    index = _spread(np.flatnonzero(allowed))
    y, x = _unit(target.reshape(-1, 3)[index]), _unit(source.reshape(-1, 3)[index])
    usable = np.isfinite(x).all(axis=1) & ((y > _SATURATED[0]) & (y < _SATURATED[1])).all(axis=1)
    y, x = y[usable], x[usable]
    if len(y) < _LEAST_PIXELS:
        return ColourFit.identity()
    channels = [_fit_channel(x[:, c], y[:, c], max_gain) for c in range(3)]
    gain, offset, residual = (np.array(values) for values in zip(*channels, strict=True))
    within = np.abs(y - x * gain - offset) <= 3 * np.maximum(residual, 1 / 255)
    return ColourFit(gain, offset, residual, float(within.all(axis=1).mean()), len(y))


def match_colours(
    render: ArrayLike, image: ArrayLike, mask: ArrayLike | None = None
) -> NDArray[np.float32]:
    """The render in the image's exposure and white balance; as it is where no fit is plausible.

    Args:
        render, image, mask: as `fit_colour`.

    Returns:
        float32 [H, W, 3], 1 for white, not clipped.

    Raises:
        ImageError: sizes that differ.
    """
    fit = fit_colour(image, render, mask)
    return fit.apply(render) if fit.plausible else np.asarray(_unit(render), np.float32)


def _spread(index: NDArray[np.int64]) -> NDArray[np.int64]:
    """At most _MOST_PIXELS of the indices, at random but the same ones each time."""
    if len(index) <= _MOST_PIXELS:
        return index
    return np.asarray(index[np.random.default_rng(0).integers(0, len(index), _MOST_PIXELS)])


def _unit(colours: ArrayLike) -> Array:
    array = np.asarray(colours)
    return array / 255.0 if array.dtype.kind in "ui" else np.asarray(array, np.float64)


def _fit_channel(x: Array, y: Array, max_gain: float) -> tuple[float, float, float]:
    """Gain, offset and robust deviation of y = gain * x + offset."""
    if float(np.subtract(*np.percentile(x, [95, 5]))) < 4 / 255:
        shift = y - x
        return 1.0, float(np.median(shift)), _deviation(shift - np.median(shift))
    gain = float(np.clip(_repeated_median(x, y), 1 / max_gain, max_gain))
    offset = float(np.median(y - gain * x))
    for _ in range(20):
        residual = y - gain * x - offset
        scaled = np.abs(residual) / max(_deviation(residual), 1e-4)
        weight = np.where(scaled > 3, 0.0, np.minimum(1, _HUBER / np.maximum(scaled, 1e-12)))
        mean_x, mean_y = np.average(x, weights=weight), np.average(y, weights=weight)
        spread = float(np.sum(weight * (x - mean_x) ** 2))
        covariance = float(np.sum(weight * (x - mean_x) * (y - mean_y)))
        new_gain = float(np.clip(covariance / max(spread, 1e-12), 1 / max_gain, max_gain))
        new_offset = float(mean_y - new_gain * mean_x)
        done = abs(new_gain - gain) < 1e-6 and abs(new_offset - offset) < 1e-6
        gain, offset = new_gain, new_offset
        if done:
            break
    return gain, offset, _deviation(y - gain * x - offset)


def _repeated_median(x: Array, y: Array, sample: int = 250) -> float:
    """Median over points of the median slope to the other points, on a sample."""
    rng = np.random.default_rng(0)
    index = rng.choice(len(x), min(sample, len(x)), replace=False)
    dx, dy = x[index][:, None] - x[index], y[index][:, None] - y[index]
    far = np.abs(dx) > 0.25 * float(np.std(x[index]))
    slopes = np.where(far, dy / np.where(far, dx, 1.0), np.nan)
    slopes = slopes[far.any(axis=1)]
    return float(np.median(np.nanmedian(slopes, axis=1))) if len(slopes) else 1.0


def _deviation(residual: Array) -> float:
    """Standard deviation of normal residuals, from their median magnitude."""
    return 1.4826 * float(np.median(np.abs(residual)))
