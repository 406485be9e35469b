"""What may happen to a query's image: exposure, gamma, JPEG, blur, and the paper's colours."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from igaussian_core.errors import ConfigError

Image = NDArray[np.uint8]

# name: lowest and highest value
_RANGES = {
    "gain": (0.01, 100.0), "gamma": (0.1, 10.0), "jpeg": (1.0, 100.0), "blur": (0.0, 50.0),
    "noise": (0.0, 128.0),
}  # fmt: skip
SUPPORTED = "paper, gain=0.5, gamma=1.4, jpeg=40 (quality), blur=3 (px), noise=5 (grey levels)"


@dataclass(frozen=True)
class Change:
    """One change of an image: a name and, but for `paper`, its strength."""

    name: str
    value: float = 0.0

    def apply(self, image: Image, seed: int) -> Image:
        """The changed image, uint8 RGB of the same size; the seed decides what is random."""
        if self.name == "paper":
            return changed_colours(image, seed)
        if self.name == "gain":
            return _u8(image.astype(np.float32) * self.value)
        if self.name == "gamma":
            return _u8(255 * (image / np.float32(255)) ** np.float32(self.value))
        if self.name == "noise":
            noise = np.random.default_rng(seed).normal(0, self.value, image.shape)
            return _u8(image.astype(np.float32) + noise)
        if self.name == "blur":
            if self.value == 0:
                return image
            return np.asarray(cv2.GaussianBlur(image, (0, 0), self.value), np.uint8)
        _, data = cv2.imencode(
            ".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, round(self.value)]
        )
        return np.ascontiguousarray(np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))[..., ::-1])


def parse_change(text: str) -> Change:
    """`paper`, or `name=value`.

    Raises:
        ConfigError: an unknown name, no number, out of range.
    """
    name, _, number = text.partition("=")
    if text == "paper":
        return Change("paper")
    if name not in _RANGES:
        raise ConfigError(f"--change {text}: expected one of {SUPPORTED}")
    low, high = _RANGES[name]
    try:
        value = float(number)
    except ValueError as error:
        raise ConfigError(f"--change {text}: '{number}' is no number") from error
    if not low <= value <= high:
        raise ConfigError(f"--change {text}: outside [{low:g}, {high:g}]")
    return Change(name, value)


def changed(image: Image, changes: tuple[Change, ...], seed: int) -> Image:
    """The image after all changes, in their order."""
    for change in changes:
        image = change.apply(image, seed)
    return image


def changed_colours(image: Image, seed: int) -> Image:
    """Another brightness (0.7 to 1.3), white balance (+-10 %), gamma and a little noise: the
    paper's "changes in color and brightness", whose strength it does not say."""
    rng = np.random.default_rng(seed)
    gain = rng.uniform(0.7, 1.3) * rng.uniform(0.9, 1.1, 3)
    rgb = (image / np.float32(255)) ** np.float32(rng.uniform(0.85, 1.18)) * gain
    noise = rng.normal(0, 0.01, rgb.shape)
    return _u8(255 * (rgb + noise).astype(np.float32))


def _u8(values: NDArray[np.floating]) -> Image:
    return np.asarray(np.clip(np.rint(values), 0, 255), np.uint8)
