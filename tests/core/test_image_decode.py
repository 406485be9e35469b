"""Every encoding against an image whose pixels are known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from igaussian_core.errors import ImageError
from igaussian_core.image_decode import ENCODINGS, decode_compressed, decode_image

H, W = 6, 8


def _rgb() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (H, W, 3), dtype=np.uint8)


def _wide(values: np.ndarray, bigendian: bool) -> np.ndarray:
    """16-bit values that round to the given ones, of two different bytes each."""
    return (values.astype(np.uint16) * 257 - 60 * (values > 0)).astype(
        ">u2" if bigendian else "<u2"
    )


def _decode(encoding: str, array: np.ndarray, bigendian: bool = False) -> np.ndarray:
    data = array.tobytes()
    return decode_image(encoding, H, W, len(data) // H, bigendian, data)


@pytest.mark.parametrize(
    ("encoding", "order"),
    [("rgb8", [0, 1, 2]), ("bgr8", [2, 1, 0]), ("rgba8", [0, 1, 2, 1]), ("bgra8", [2, 1, 0, 1])],
)
def test_channel_order(encoding, order):
    rgb = _rgb()
    np.testing.assert_array_equal(_decode(encoding, rgb[:, :, order]), rgb)


@pytest.mark.parametrize("encoding", ["rgb16", "bgr16"])
@pytest.mark.parametrize("bigendian", [False, True])
def test_sixteen_bits_and_byte_order(encoding, bigendian):
    rgb = _rgb()
    order = [2, 1, 0] if encoding == "bgr16" else [0, 1, 2]
    wide = _wide(rgb[:, :, order], bigendian)
    np.testing.assert_array_equal(_decode(encoding, wide, bigendian), rgb)
    assert (_decode(encoding, wide, not bigendian) != rgb).any()


@pytest.mark.parametrize("bigendian", [False, True])
def test_mono(bigendian):
    grey = _rgb()[:, :, 0]
    expected = np.repeat(grey[:, :, None], 3, 2)
    np.testing.assert_array_equal(_decode("mono8", grey), expected)
    wide = _wide(grey, bigendian)
    np.testing.assert_array_equal(_decode("mono16", wide, bigendian), expected)
    assert (_decode("mono16", wide, not bigendian) != expected).any()


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
@pytest.mark.parametrize("bits", [8, 16])
def test_bayer_of_one_colour(pattern, bits):
    colour = {"r": 200, "g": 120, "b": 30}
    tile = np.array([colour[c] for c in pattern], np.uint16).reshape(2, 2)
    mosaic = np.tile(tile, (H // 2, W // 2))
    mosaic = mosaic.astype(np.uint8) if bits == 8 else (mosaic * 257).astype("<u2")
    image = _decode(f"bayer_{pattern}{bits}", mosaic)
    np.testing.assert_array_equal(image, np.full((H, W, 3), [200, 120, 30], np.uint8))


@pytest.mark.parametrize(
    ("encoding", "order"),
    [("yuv422", "uyvy"), ("uyvy", "uyvy"), ("yuv422_yuy2", "yuyv"), ("yuyv", "yuyv")],
)
def test_yuv422_of_one_colour(encoding, order):
    red = np.full((1, 1, 3), [200, 40, 60], np.uint8)
    r, g, b = (int(v) for v in red[0, 0])
    luma = 16 + (66 * r + 129 * g + 25 * b) / 256  # BT.601, limited range
    values = {
        "y": luma,
        "u": 128 + (-38 * r - 74 * g + 112 * b) / 256,
        "v": 128 + (112 * r - 94 * g - 18 * b) / 256,
    }
    row = np.array([round(values[c]) for c in order] * (W // 2), np.uint8)
    image = _decode(encoding, np.tile(row, (H, 1)))
    assert np.abs(image.astype(int) - red).max() <= 3


@given(padding=st.integers(0, 9), cut_last=st.booleans())
def test_row_padding(padding, cut_last):
    rgb = _rgb()
    step = W * 3 + padding
    rows = np.full((H, step), 255, np.uint8)
    rows[:, : W * 3] = rgb.reshape(H, -1)
    data = rows.tobytes()
    data = data[: len(data) - padding] if cut_last else data
    np.testing.assert_array_equal(decode_image("rgb8", H, W, step, False, data), rgb)


def test_result_is_a_copy():
    data = bytearray(_rgb().tobytes())
    image = decode_image("rgb8", H, W, W * 3, False, data)
    before = image.copy()
    data[:] = bytes(len(data))
    np.testing.assert_array_equal(image, before)
    assert image.flags.writeable and image.flags.c_contiguous


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("32FC1", H, W, W * 4, False, bytes(H * W * 4)), "32FC1.*supported: rgb8"),
        (("rgb8", H, W, W, False, bytes(H * W)), "step 8 is too small"),
        (("rgb8", H, W, W * 3, False, bytes(H * W * 3 - 1)), "takes 144 bytes, got 143"),
        (("rgb8", H, W, W * 3, False, bytes(H * (W * 3 + 8))), "takes 144 bytes, got 192"),
        (("rgb8", H, W, W * 3, False, b""), "got 0"),
        (("rgb8", 0, W, W * 3, False, b""), "not positive"),
        (("bayer_rggb8", 5, W, W, False, bytes(5 * W)), "cannot have a size of 8x5"),
        (("yuv422", H, 7, 14, False, bytes(H * 14)), "cannot have a size of 7x6"),
    ],
)
def test_refused(arguments, message):
    with pytest.raises(ImageError, match=message):
        decode_image(*arguments)


def test_every_encoding_gives_rgb():
    for encoding in ENCODINGS:
        values = 1 if encoding.startswith(("mono", "bayer")) else 2
        values = {"rgb": 3, "bgr": 3}.get(encoding.rstrip("168a"), values)
        values = 4 if encoding.startswith(("rgba", "bgra")) else values
        values = int(encoding[-1]) if "UC" in encoding else values
        size = values * (2 if "16" in encoding else 1)
        image = decode_image(encoding, H, W, W * size, False, bytes(H * W * size))
        assert image.shape == (H, W, 3) and image.dtype == np.uint8, encoding


def test_compressed():
    rgb = _rgb()
    png = cv2.imencode(".png", rgb[:, :, ::-1])[1].tobytes()
    np.testing.assert_array_equal(decode_compressed(png), rgb)
    flat = np.full((16, 16, 3), [200, 100, 50], np.uint8)
    jpeg = cv2.imencode(".jpg", flat[:, :, ::-1])[1].tobytes()
    assert np.abs(decode_compressed(jpeg).astype(int) - flat).max() <= 3


@pytest.mark.parametrize("data", [b"", b"not an image at all", bytes([0xFF, 0xD8, 0xFF])])
def test_compressed_refused(data):
    with pytest.raises(ImageError, match="photo"):
        decode_compressed(data, "photo")
