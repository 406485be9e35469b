"""The .spz format of Niantic, versions 1 to 4 (format description in the readme of spz).

Versions 1 to 3 are one gzip stream (also met without the gzip), version 4 a plain header and a
zstd stream for each attribute. Coordinates are stored right-up-back; ours, the .ply's, are
right-down-front, half a turn about x. An extension record may name other axes.
"""

from __future__ import annotations

import gzip
import logging
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import zstandard
from numpy.typing import NDArray

from igaussian_core.errors import MapError
from igaussian_core.formats.raw import RawGaussians, check_plausible, quats_from_smallest_three

log = logging.getLogger(__name__)
Bytes = NDArray[np.uint8]

_MAGIC = 0x5053474E  # "NGSP"
_LEGACY_HEADER = struct.Struct("<IIIBBBB")
_HEADER = struct.Struct("<IIIBBBBI12x")
_ANTIALIASED, _HAS_EXTENSIONS = 1, 2
_COORDINATES_EXTENSION = 0xADBE0003
_COLOUR_SCALE = 0.15
_SH_VALUES = {0: 0, 1: 9, 2: 24, 3: 45, 4: 72}
_MOST_EXTENSION_BYTES = 1 << 20
_RIGHT_UP_BACK = 4
# signs of the SH basis functions 1..15 under x -> -x, y -> -y, z -> -z, from their monomials
_SH_PARITY = np.array(
    [[1, 1, -1, -1, 1, 1, -1, 1, 1, -1, 1, 1, -1, 1, -1],
     [-1, 1, 1, -1, -1, 1, 1, 1, -1, -1, -1, 1, 1, 1, 1],
     [1, -1, 1, 1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, 1]], np.float32
)  # fmt: skip


@dataclass(frozen=True)
class _Header:
    version: int
    count: int
    degree: int
    fractional_bits: int
    flags: int

    def sizes(self) -> list[int]:
        """Bytes of positions, alphas, colours, scales, rotations, harmonics."""
        position = 6 if self.version == 1 else 9
        rotation = 3 if self.version < 3 else 4
        return [self.count * n for n in (position, 1, 3, 3, rotation, _SH_VALUES[self.degree])]


def read(file: Path) -> RawGaussians:
    """Read a .spz file of version 1 to 4.

    Raises:
        MapError: truncated, altered, or of another version.
    """
    data = file.read_bytes()
    if data[:2] == b"\x1f\x8b":
        data = _gunzip(file, data)
    if len(data) < _LEGACY_HEADER.size:
        raise MapError(f"{file}: truncated .spz: {len(data)} bytes")
    magic, version = struct.unpack_from("<II", data)
    if magic != _MAGIC:
        raise MapError(f"{file}: gzip, but no .spz inside; supported: .spz, not other archives")
    if version not in (1, 2, 3, 4):
        raise MapError(f"{file}: .spz version {version}; versions 1 to 4 are supported")
    header, streams, extensions = (_read_v4 if version == 4 else _read_legacy)(file, data)
    signs = _axis_signs(file, extensions)
    return _decode(file, header, streams, signs)


def _gunzip(file: Path, data: bytes) -> bytes:
    """Payload of the gzip stream, never more than its own header asks for."""
    stream = zlib.decompressobj(wbits=31)
    try:
        head = stream.decompress(data, _LEGACY_HEADER.size)
        if len(head) < _LEGACY_HEADER.size or not head.startswith(b"NGSP"):
            return head
        header = _legacy_header(file, head, len(data))
        wanted = sum(header.sizes()) + _MOST_EXTENSION_BYTES
        data = head + stream.decompress(stream.unconsumed_tail, wanted)
    except zlib.error as error:
        raise MapError(f"{file}: damaged gzip stream: {error}") from error
    if not stream.eof:  # reached only with the right checksum
        raise MapError(f"{file}: truncated .spz, or longer than its header declares")
    return data


def _check(file: Path, header: _Header, stored_bytes: int) -> _Header:
    if header.degree not in _SH_VALUES:
        raise MapError(f"{file}: .spz with spherical harmonics of degree {header.degree}")
    if header.fractional_bits > 23:
        raise MapError(f"{file}: .spz with {header.fractional_bits} fractional bits of 24")
    check_plausible(file, header.count, stored_bytes)
    return header


def _legacy_header(file: Path, data: bytes, stored_bytes: int) -> _Header:
    _, version, count, degree, bits, flags, _ = _LEGACY_HEADER.unpack_from(data)
    return _check(file, _Header(version, count, degree, bits, flags), stored_bytes)


def _read_legacy(file: Path, data: bytes) -> tuple[_Header, list[Bytes], bytes]:
    header = _legacy_header(file, data, len(data))
    streams: list[Bytes] = []
    offset = _LEGACY_HEADER.size
    for size in header.sizes():
        if offset + size > len(data):
            raise MapError(f"{file}: truncated .spz: {len(data)} bytes where "
                           f"{_LEGACY_HEADER.size + sum(header.sizes())} are declared")  # fmt: skip
        streams.append(np.frombuffer(data, np.uint8, size, offset))
        offset += size
    return header, streams, data[offset:] if header.flags & _HAS_EXTENSIONS else b""


def _read_v4(file: Path, data: bytes) -> tuple[_Header, list[Bytes], bytes]:
    if len(data) < _HEADER.size:
        raise MapError(f"{file}: truncated .spz: {len(data)} bytes")
    _, version, count, degree, bits, flags, n_streams, table = _HEADER.unpack_from(data)
    header = _check(file, _Header(version, count, degree, bits, flags), len(data))
    sizes = header.sizes()
    if n_streams < (6 if degree else 5) or table < _HEADER.size:
        raise MapError(f"{file}: damaged .spz header: {n_streams} streams, table at {table}")
    offset = table + 16 * n_streams
    if offset > len(data):
        raise MapError(f"{file}: truncated .spz: table of contents lies beyond the end")
    entries = struct.unpack_from(f"<{2 * n_streams}Q", data, table)
    streams: list[Bytes] = []
    for stored, declared, size in zip(entries[::2], entries[1::2], sizes, strict=False):
        if declared != size or offset + stored > len(data):
            raise MapError(f"{file}: truncated or damaged .spz: stream {len(streams) + 1}")
        streams.append(_unzstd(file, data[offset : offset + stored], size))
        offset += stored
    if len(streams) == 5:
        streams.append(np.zeros(0, np.uint8))
    return header, streams, data[_HEADER.size : table] if flags & _HAS_EXTENSIONS else b""


def _unzstd(file: Path, data: bytes, size: int) -> Bytes:
    try:
        # as a stream: the frame's own idea of its size is not to be trusted
        with zstandard.ZstdDecompressor().stream_reader(data) as reader:
            content = reader.read(size)
    except zstandard.ZstdError as error:
        raise MapError(f"{file}: damaged zstd stream: {error}") from error
    if len(content) != size:
        raise MapError(f"{file}: truncated .spz: a stream of {len(content)} bytes, not {size}")
    return np.frombuffer(content, np.uint8)


def _axis_signs(file: Path, extensions: bytes) -> NDArray[np.float32]:
    """Signs [3] that take the file's axes to right, down, front."""
    system, offset = _RIGHT_UP_BACK, 0
    while offset + 8 <= len(extensions):
        kind, size = struct.unpack_from("<II", extensions, offset)
        if kind == _COORDINATES_EXTENSION and size == 4 and offset + 12 <= len(extensions):
            system = struct.unpack_from("<I", extensions, offset + 8)[0] or _RIGHT_UP_BACK
        offset += 8 + size
    if not 1 <= system <= 8:
        raise MapError(f"{file}: .spz in coordinate system {system}, which swaps axes; "
                       "supported: systems 1 to 8 (x sideways, y vertical)")  # fmt: skip
    right, up, front = ((system - 1) >> bit & 1 for bit in range(3))
    return np.array([1 if right else -1, -1 if up else 1, 1 if front else -1], np.float32)


def _decode(
    file: Path, header: _Header, streams: list[Bytes], signs: NDArray[np.float32]
) -> RawGaussians:
    positions, alphas, colours, scales, rotations, harmonics = streams
    count = header.count
    sh = np.empty((count, 1 + _SH_VALUES[header.degree] // 3, 3), np.float32)
    sh[:, 0] = (colours.reshape(-1, 3).astype(np.float32) / 255 - 0.5) / _COLOUR_SCALE
    sh[:, 1:] = (harmonics.reshape(count, sh.shape[1] - 1, 3).astype(np.float32) - 128) / 128
    if header.degree == 4:
        log.warning("%s: spherical harmonics of degree 4 are cut to degree 3", file)
        sh = np.ascontiguousarray(sh[:, :16])
    with np.errstate(invalid="ignore"):  # not-a-number among half floats; left out later
        means = _positions(header, positions) * signs
    return RawGaussians(
        means=means,
        quats_wxyz=_quats(header, rotations, signs),
        scales=np.exp(scales.reshape(-1, 3).astype(np.float32) / 16 - 10),
        opacities=alphas.astype(np.float32) / np.float32(255),
        sh=_mirrored(sh, signs),
        antialiased=bool(header.flags & _ANTIALIASED),
        file_format=f".spz version {header.version}",
    )


def _positions(header: _Header, data: Bytes) -> NDArray[np.float32]:
    if header.version == 1:
        return data.view("<f2").reshape(-1, 3).astype(np.float32)
    low, middle, high = data.reshape(-1, 3, 3).astype(np.int32).transpose(2, 0, 1)
    fixed = low | (middle << 8) | (high << 16)
    fixed -= (fixed & 0x800000) << 1
    return (fixed / float(1 << header.fractional_bits)).astype(np.float32)


def _quats(header: _Header, data: Bytes, signs: NDArray[np.float32]) -> NDArray[np.float32]:
    if header.version < 3:
        xyz = data.reshape(-1, 3).astype(np.float32) / np.float32(127.5) - 1
        w = np.sqrt(np.maximum(0, 1 - np.sum(xyz * xyz, axis=1)))
        quats = np.concatenate([w[:, None], xyz], axis=1)
    else:
        packed = data.view("<u4")
        small = np.empty((len(packed), 3), np.float32)
        for i, shift in enumerate((20, 10, 0)):
            field = (packed >> shift) & 1023
            magnitude = (field & 511) * np.float32(np.sqrt(0.5) / 511)
            small[:, i] = np.where(field >> 9, -magnitude, magnitude)
        quats = quats_from_smallest_three(packed >> 30, small, order=(3, 0, 1, 2))
    # a rotation axis is a pseudovector: reversing one axis reverses the other two components
    return np.asarray(quats * np.array([1, *(np.prod(signs) * signs)], np.float32))


def _mirrored(sh: NDArray[np.float32], signs: NDArray[np.float32]) -> NDArray[np.float32]:
    """Harmonics [N, K, 3] of the same colours seen in axes of other signs."""
    factors = np.prod(_SH_PARITY[signs < 0], axis=0, initial=1.0)
    sh[:, 1:] *= factors[: sh.shape[1] - 1, None].astype(np.float32)
    return sh


def write(gaussians: RawGaussians, file: Path) -> None:
    """Write version 3, the newest that is gzip and nothing else, so that all readers take it.

    Positions are kept to 2^-b units with as many fractional bits b as the largest coordinate
    leaves of 24; scales within 3.2 % between 4.5e-5 and 380 units, and clipped to those.

    Raises:
        MapError: a coordinate of 2^23 units or more.
    """
    count, coefficients = gaussians.sh.shape[:2]
    largest = float(np.abs(gaussians.means).max(initial=1e-3))
    if largest >= 2**23 - 1:
        raise MapError(f"{file}: .spz holds coordinates up to 2^23, not {largest:g}")
    bits = int(np.clip(np.floor(np.log2((2**23 - 1) / largest)), 0, 20))
    signs = np.array([1, -1, -1], np.float32)
    fixed = np.rint(gaussians.means.astype(np.float64) * signs * (1 << bits)).astype("<i4")
    quats = gaussians.quats_wxyz * np.array([1, *(np.prod(signs) * signs)], np.float32)
    sh = _mirrored(gaussians.sh.copy(), signs)
    with np.errstate(divide="ignore"):
        log_scales = np.log(gaussians.scales.astype(np.float32))
    parts = [
        _LEGACY_HEADER.pack(_MAGIC, 3, count, int(np.sqrt(coefficients)) - 1, bits,
                            _ANTIALIASED if gaussians.antialiased else 0, 0),
        np.ascontiguousarray(fixed.view(np.uint8).reshape(count, 3, 4)[..., :3]).tobytes(),
        _to_bytes(gaussians.opacities * 255),
        _to_bytes((sh[:, 0] * _COLOUR_SCALE + 0.5) * 255),
        _to_bytes((np.clip(log_scales, -20, 20) + 10) * 16),
        _packed_quats(quats).tobytes(),
        _to_bytes(sh[:, 1:] * 128 + 128),
    ]  # fmt: skip
    file.write_bytes(gzip.compress(b"".join(parts), compresslevel=6, mtime=0))


def _to_bytes(values: NDArray[np.float32]) -> bytes:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8).tobytes()


def _packed_quats(quats_wxyz: NDArray[np.float32]) -> NDArray[np.uint32]:
    """Two bits for the largest of x, y, z, w, and sign and nine bits for each of the others."""
    xyzw = np.roll(quats_wxyz, -1, axis=1)
    largest = np.abs(xyzw).argmax(axis=1)
    xyzw = xyzw * np.where(np.take_along_axis(xyzw, largest[:, None], 1) < 0, -1, 1)
    packed = largest.astype(np.uint32)
    for place in range(4):
        value = xyzw[:, place]
        magnitude = np.clip(np.rint(np.abs(value) * (511 * np.sqrt(2))), 0, 511).astype(np.uint32)
        field = magnitude | (value < 0).astype(np.uint32) << 9
        packed = np.where(largest == place, packed, packed << 10 | field).astype(np.uint32)
    return packed.astype("<u4")
