"""The .sog format of PlayCanvas, versions 1 and 2: lossless WebP images and a meta.json.

Pixel i of every image belongs to Gaussian i. Positions are 16 bits between log-mapped bounds;
scales and colours index a codebook of 256 (version 1: a linear range); harmonics beyond the
colour come from a palette of whole coefficient sets.
"""

from __future__ import annotations

import json
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path, PurePosixPath
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from igaussian_core.errors import MapError
from igaussian_core.formats.raw import RawGaussians, quats_from_smallest_three

Bytes = NDArray[np.uint8]
_MOST_PIXELS = 1 << 26
_MOST_FILE_BYTES = 1 << 29
# RuntimeError: encrypted; NotImplementedError: an unknown version or method
_ZIP_ERRORS = (zipfile.BadZipFile, NotImplementedError, RuntimeError, ValueError, EOFError,
               zlib.error)  # fmt: skip
_PALETTE_COLUMNS = 64
_COEFFICIENTS = {1: 3, 2: 8, 3: 15}  # SH bands -> coefficients beyond the constant one


class _Parts:
    """The files of one .sog, read by name."""

    def __init__(self, origin: Path, fetch: Callable[[str], bytes]) -> None:
        self.origin, self._fetch = origin, fetch
        try:
            self.meta: Any = json.loads(fetch("meta.json"))
        except ValueError as error:
            raise MapError(f"{origin}: meta.json is no JSON: {error}") from error

    def pixels(self, name: Any, channels: int, count: int) -> Bytes:
        """The first `count` pixels [count, channels], RGB order."""
        image = self.image(name, channels)
        if image.shape[0] * image.shape[1] < count:
            raise MapError(f"{self.origin}: {name} holds {image.shape[0] * image.shape[1]} "
                           f"pixels for {count} Gaussians")  # fmt: skip
        return image.reshape(-1, channels)[:count]

    def image(self, name: Any, channels: int) -> Bytes:
        """An image [H, W, channels], RGB order."""
        if not isinstance(name, str) or PurePosixPath(name).name != name:
            raise MapError(f"{self.origin}: meta.json names a file outside: {name!r}")
        data = self._fetch(name)
        _check_webp_size(self.origin, name, data)
        try:
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        except cv2.error:
            image = None
        if image is None or image.dtype != np.uint8 or image.ndim != 3:
            raise MapError(f"{self.origin}: {name} is no readable 8-bit colour image")
        if channels == 4 and image.shape[2] == 3:  # the encoder drops an alpha of 255
            return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGBA), np.uint8)
        code = {(3, 3): cv2.COLOR_BGR2RGB, (4, 3): cv2.COLOR_BGRA2RGB, (4, 4): cv2.COLOR_BGRA2RGBA}
        return np.asarray(cv2.cvtColor(image, code[image.shape[2], channels]), np.uint8)


def read_folder(folder: Path) -> RawGaussians:
    """Read a folder with meta.json and images.

    Raises:
        MapError: files missing, damaged or not belonging together.
    """

    def fetch(name: str) -> bytes:
        file = folder / name
        if not file.is_file():
            raise MapError(f"{folder}: {name} is missing")
        return file.read_bytes()

    return _read(_Parts(folder, fetch))


def read_archive(file: Path) -> RawGaussians:
    """Read a .sog archive, a zip of the same files at its root.

    Raises:
        MapError: files missing, damaged or not belonging together.
    """

    def fetch(name: str) -> bytes:
        try:
            info = archive.getinfo(name)
            if info.file_size > _MOST_FILE_BYTES:
                raise MapError(f"{file}: {name} unpacks to {info.file_size} bytes")
            return archive.read(info)
        except KeyError as error:
            raise MapError(f"{file}: a zip archive without {name}; supported: .sog") from error
        except _ZIP_ERRORS as error:
            raise MapError(f"{file}: {name} is damaged: {error}") from error

    try:
        with zipfile.ZipFile(file) as archive:
            return _read(_Parts(file, fetch))
    except _ZIP_ERRORS as error:
        raise MapError(f"{file}: damaged zip archive: {error}") from error


def _read(parts: _Parts) -> RawGaussians:
    meta = parts.meta
    try:
        version = meta.get("version", 1)
        if version not in (1, 2):
            raise MapError(f"{parts.origin}: .sog version {version}; 1 and 2 are supported")
        count = int(meta["count"] if version == 2 else meta["means"]["shape"][0])
        if not 0 <= count <= _MOST_PIXELS:
            raise MapError(f"{parts.origin}: declares {count} Gaussians")
        return _decode(parts, version, count)
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        cause = f"{type(error).__name__}: {error}"
        raise MapError(f"{parts.origin}: meta.json is incomplete or damaged ({cause})") from error


def _decode(parts: _Parts, version: int, count: int) -> RawGaussians:
    meta = parts.meta
    colour = parts.pixels(meta["sh0"]["files"][0], 4, count)
    scales = parts.pixels(meta["scales"]["files"][0], 3, count)
    if version == 2:
        log_scales = _codebook(meta["scales"])[scales]
        dc, opacities = _codebook(meta["sh0"])[colour[:, :3]], colour[:, 3] / np.float32(255)
    else:
        log_scales = _between(scales / np.float32(255), meta["scales"], 3)
        values = _between(colour / np.float32(255), meta["sh0"], 4)
        dc, opacities = values[:, :3], 1 / (1 + np.exp(-values[:, 3]))
    with np.errstate(over="ignore"):
        linear_scales = np.exp(log_scales)
    return RawGaussians(
        means=_means(parts, count),
        quats_wxyz=_quats(parts, count),
        scales=linear_scales.astype(np.float32),
        opacities=opacities.astype(np.float32),
        sh=np.concatenate([dc[:, None], _harmonics(parts, version, count)], axis=1),
        antialiased=meta.get("antialias") is True or meta.get("model") == "antialiased",
        file_format=f".sog version {version}",
    )


def _means(parts: _Parts, count: int) -> NDArray[np.float32]:
    low, high = (parts.pixels(name, 3, count) for name in parts.meta["means"]["files"][:2])
    unit = (low.astype(np.uint16) | high.astype(np.uint16) << 8) / np.float64(65535)
    mapped = _between(unit, parts.meta["means"], 3)
    with np.errstate(over="ignore"):  # sign(x) ln(1 + |x|) is what was stored
        return (np.sign(mapped) * np.expm1(np.abs(mapped))).astype(np.float32)


def _quats(parts: _Parts, count: int) -> NDArray[np.float32]:
    pixels = parts.pixels(parts.meta["quats"]["files"][0], 4, count)
    small = (pixels[:, :3] / np.float32(255) * 2 - 1) * np.float32(np.sqrt(0.5))
    quats = quats_from_smallest_three(pixels[:, 3].astype(np.int16) - 252, small)
    quats[pixels[:, 3] < 252] = 0  # no such index: left out as damaged
    return quats


def _harmonics(parts: _Parts, version: int, count: int) -> NDArray[np.float32]:
    """Coefficients beyond the constant one [count, K - 1, 3]."""
    meta = parts.meta.get("shN")
    if not meta:
        return np.zeros((count, 0, 3), np.float32)
    palette = parts.image(meta["files"][0], 3)
    labels = parts.pixels(meta["files"][1], 3, count)
    index = labels[:, 0].astype(np.int64) | labels[:, 1].astype(np.int64) << 8
    coefficients = palette.shape[1] // _PALETTE_COLUMNS
    declared = _COEFFICIENTS.get(meta["bands"]) if "bands" in meta else coefficients
    if coefficients not in _COEFFICIENTS.values() or coefficients != declared:
        raise MapError(f"{parts.origin}: a palette {palette.shape[1]} pixels wide does not hold "
                       "spherical harmonics of degree 1 to 3")  # fmt: skip
    entries = palette[:, : _PALETTE_COLUMNS * coefficients].reshape(-1, coefficients, 3)
    if count and index.max() >= len(entries):
        raise MapError(f"{parts.origin}: label {index.max()} of {len(entries)} palette entries")
    if version == 2:
        return _codebook(meta)[entries[index]]
    low, high = np.float32(meta["mins"]), np.float32(meta["maxs"])
    return np.asarray(low + (high - low) * (entries[index] / np.float32(255)), np.float32)


def _codebook(part: dict[str, Any]) -> NDArray[np.float32]:
    codebook = np.array(part["codebook"], np.float32)
    if codebook.shape != (256,):
        raise ValueError(f"a codebook of {codebook.size} values, not 256")
    return codebook


def _between(unit: NDArray[Any], part: dict[str, Any], channels: int) -> NDArray[Any]:
    """Values in [0, 1] taken to the part's ranges, by channel."""
    low, high = np.array(part["mins"], unit.dtype), np.array(part["maxs"], unit.dtype)
    if low.shape != (channels,) or high.shape != (channels,):
        raise ValueError(f"mins and maxs of {low.size} and {high.size} values, not {channels}")
    return np.asarray(low + (high - low) * unit)


def _check_webp_size(origin: Path, name: str, data: bytes) -> None:
    """Refuse a small file that unpacks to a giant image."""
    if data[:4] != b"RIFF" or data[8:12] != b"WEBP" or len(data) < 30:
        raise MapError(f"{origin}: {name} is no WebP image")
    if data[12:16] == b"VP8L":
        packed = int.from_bytes(data[21:25], "little")
        width, height = (packed & 0x3FFF) + 1, (packed >> 14 & 0x3FFF) + 1
    elif data[12:16] == b"VP8X":
        width = int.from_bytes(data[24:27], "little") + 1
        height = int.from_bytes(data[27:30], "little") + 1
    else:
        raise MapError(f"{origin}: {name} is lossy WebP, whose values are not exact")
    if width * height > _MOST_PIXELS:
        raise MapError(f"{origin}: {name} is an image of {width}x{height} pixels")
