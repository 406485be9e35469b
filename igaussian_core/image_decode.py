"""Pixels of a ROS image message as uint8 RGB, from plain arguments; knows nothing of ROS.

The one place that knows encodings, shared by the bag reader and the node.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from igaussian_core.errors import ImageError


@dataclass(frozen=True)
class _Encoding:
    channels: int  # values a pixel in the message
    bits: int  # of one value
    to_rgb: int | None  # OpenCV's conversion code; None where it is RGB already
    even: tuple[int, int] = (1, 1)  # width and height must be multiples of these


_BAYER = {
    "rggb": cv2.COLOR_BayerRGGB2RGB,
    "bggr": cv2.COLOR_BayerBGGR2RGB,
    "gbrg": cv2.COLOR_BayerGBRG2RGB,
    "grbg": cv2.COLOR_BayerGRBG2RGB,
}


def _encodings() -> dict[str, _Encoding]:
    table: dict[str, _Encoding] = {}
    for bits in (8, 16):
        table |= {
            f"rgb{bits}": _Encoding(3, bits, None),
            f"bgr{bits}": _Encoding(3, bits, cv2.COLOR_BGR2RGB),
            f"rgba{bits}": _Encoding(4, bits, cv2.COLOR_RGBA2RGB),
            f"bgra{bits}": _Encoding(4, bits, cv2.COLOR_BGRA2RGB),
            f"mono{bits}": _Encoding(1, bits, cv2.COLOR_GRAY2RGB),
        }
        for pattern, code in _BAYER.items():
            table[f"bayer_{pattern}{bits}"] = _Encoding(1, bits, code, (2, 2))
    uyvy = _Encoding(2, 8, cv2.COLOR_YUV2RGB_UYVY, (2, 1))
    yuyv = _Encoding(2, 8, cv2.COLOR_YUV2RGB_YUYV, (2, 1))
    # "yuv422" and "yuv422_yuy2" are the names up to Humble, "uyvy" and "yuyv" the newer ones
    table |= {"yuv422": uyvy, "uyvy": uyvy, "yuv422_yuy2": yuyv, "yuyv": yuyv}
    # OpenCV's type names say nothing of colour; its own order is blue first
    table |= {"8UC1": table["mono8"], "8UC3": table["bgr8"], "8UC4": table["bgra8"]}
    table |= {"16UC1": table["mono16"]}
    return table


_ENCODINGS = _encodings()
ENCODINGS: tuple[str, ...] = tuple(_ENCODINGS)


def decode_image(
    encoding: str, height: int, width: int, step: int, is_bigendian: bool, data: Any
) -> NDArray[np.uint8]:
    """uint8 RGB [height, width, 3] of a raw image; the result never shares memory with data.

    Args:
        encoding: one of ENCODINGS (the names of sensor_msgs/image_encodings.hpp).
        height, width: size in pixels.
        step: bytes from one row's begin to the next's, padding included.
        is_bigendian: byte order of 16-bit values; these are scaled to 8 bits by 1/257.
        data: the bytes, any object with the buffer protocol.

    Raises:
        ImageError: an unknown encoding, or sizes, step and number of bytes that disagree.
    """
    kind = _ENCODINGS.get(encoding)
    if kind is None:
        raise ImageError(
            f"image: encoding '{encoding}' is not supported; supported: {', '.join(ENCODINGS)}"
        )
    if height <= 0 or width <= 0:
        raise ImageError(f"image: size {width}x{height} is not positive")
    if width % kind.even[0] or height % kind.even[1]:
        raise ImageError(f"image: {encoding} cannot have a size of {width}x{height}")
    values = _rows(encoding, kind, height, width, step, is_bigendian, data)
    if kind.bits == 16:
        values = _to_8_bits(values)
    if kind.to_rgb is None:
        return np.array(values, np.uint8)
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(values), kind.to_rgb), np.uint8)


def decode_compressed(data: Any, name: str = "compressed image") -> NDArray[np.uint8]:
    """uint8 RGB [H, W, 3] of JPEG, PNG or another file that OpenCV reads.

    Args:
        data: the file's bytes, any object with the buffer protocol.
        name: what the error message calls it.

    Raises:
        ImageError: no image, or a truncated one that the decoder refuses.
    """
    buffer = np.frombuffer(data, np.uint8)
    if buffer.size == 0:
        raise ImageError(f"{name}: no bytes")
    try:
        image = cv2.imdecode(buffer, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error as error:
        raise ImageError(f"{name}: cannot be decoded: {error.err}") from error
    if image is None:
        head = bytes(buffer[:4]).hex(" ")
        raise ImageError(
            f"{name}: {buffer.size} bytes beginning with {head} are no JPEG, PNG or other image"
        )
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)


def _rows(
    encoding: str,
    kind: _Encoding,
    height: int,
    width: int,
    step: int,
    is_bigendian: bool,
    data: Any,
) -> NDArray[Any]:
    """The values without row padding, [H, W] or [H, W, C], uint8 or uint16 of either order."""
    buffer = np.frombuffer(data, np.uint8)
    row_bytes = width * kind.channels * kind.bits // 8
    if step < row_bytes:
        raise ImageError(
            f"image: step {step} is too small, a row of {width} {encoding} pixels "
            f"takes {row_bytes} bytes"
        )
    # some drivers leave the padding of the last row out
    last_unpadded = step * (height - 1) + row_bytes
    if buffer.size not in (step * height, last_unpadded):
        raise ImageError(
            f"image: {width}x{height} {encoding} with step {step} takes {step * height} bytes, "
            f"got {buffer.size}"
        )
    rows = np.lib.stride_tricks.as_strided(buffer, (height, row_bytes), (step, 1), writeable=False)
    if kind.bits == 16:
        rows = np.ascontiguousarray(rows).view(">u2" if is_bigendian else "<u2")
    return rows if kind.channels == 1 else rows.reshape(height, width, kind.channels)


def _to_8_bits(values: NDArray[Any]) -> NDArray[np.uint8]:
    """0..65535 to 0..255, rounded."""
    return ((values.astype(np.uint32) + 128) // 257).astype(np.uint8)
